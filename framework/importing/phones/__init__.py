"""Import of phone recordings."""
