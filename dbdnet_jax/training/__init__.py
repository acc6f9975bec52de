"""What each stage learns, and the loop that all of them go through."""
