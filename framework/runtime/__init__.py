"""Runtime of the mapping loop: threads, signals, logging and process settings."""
