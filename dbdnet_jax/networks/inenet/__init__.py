"""INENet (Zhang et al. 2023): the points of a source that a target contains, by one threshold."""
