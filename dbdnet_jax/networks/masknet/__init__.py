"""MaskNet (Sarode et al. 2020): which points of a template a partial source contains."""
