"""Reports that people look at: pages of interactive figures, and pictures."""
