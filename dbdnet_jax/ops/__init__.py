"""One pair or one cloud at a time: pure functions without parameters."""
