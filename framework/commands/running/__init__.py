"""Commands that run the pipeline or parts of it."""
