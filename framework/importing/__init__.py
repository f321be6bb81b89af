"""Import of phone and sensor recordings as RGB-D folders."""
