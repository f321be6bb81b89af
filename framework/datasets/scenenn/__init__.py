"""SceneNN's files: one module a format, tolerant in reading and strict in writing."""
