"""Import of recordings of phone apps."""
