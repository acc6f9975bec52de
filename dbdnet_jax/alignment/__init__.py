"""What `align` is made of: reading, thinning, search, judgement and verdict of two clouds."""
