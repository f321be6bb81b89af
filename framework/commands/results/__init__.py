"""Commands for stored runs."""
