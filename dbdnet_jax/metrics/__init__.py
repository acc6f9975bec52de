"""How far a pose is from the true one, and which share of the pairs is right."""
