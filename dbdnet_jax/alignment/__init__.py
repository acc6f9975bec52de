"""What `align` is made of: reading, thinning, search, quality and verdict of two clouds."""
