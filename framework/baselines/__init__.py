"""Maps of the systems that we are compared with, re-implemented or off the shelf."""
