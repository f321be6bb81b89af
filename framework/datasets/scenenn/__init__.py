"""SceneNN's files: one module per format, with lenient readers and strict writers."""
