"""Label spaces, color names and text queries."""
