"""Writing of folders: locks, replacement of several files at once, restarts after interruptions."""
