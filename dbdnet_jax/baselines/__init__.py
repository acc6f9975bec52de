"""Classical methods to measure against, each (source, target) -> Rigid."""
