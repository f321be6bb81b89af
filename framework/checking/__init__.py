"""Whether a recording can be mapped, and which of its conventions stands in the way."""
