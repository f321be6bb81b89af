"""Ground-truth instances of datasets."""
