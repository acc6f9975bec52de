"""Methods over test pairs, and the tables of their errors."""
