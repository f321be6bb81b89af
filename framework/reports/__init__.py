"""What a run leaves behind, and what is made of many runs."""
