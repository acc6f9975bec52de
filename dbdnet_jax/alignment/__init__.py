"""What `align` is made of: reading, downsampling, search, quality and validity of two clouds."""
