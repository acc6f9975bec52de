"""DBDNet: both networks, and `register`."""
