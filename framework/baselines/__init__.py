"""Maps of baseline systems, re-implemented or off the shelf."""
