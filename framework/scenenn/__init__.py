"""The files of SceneNN: one module a format, tolerant in reading and strict in writing."""
