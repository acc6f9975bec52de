"""Methods without parameters, (source, target) -> transform, and the refinement of a pose."""
