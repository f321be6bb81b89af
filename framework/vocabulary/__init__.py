"""Class names, color names and text queries."""
