"""Commands that create, check and convert sequences."""
