"""Manual correction of the instances of stored runs."""
