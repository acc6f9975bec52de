"""Data sets and the protocol that turns shapes into pairs."""
