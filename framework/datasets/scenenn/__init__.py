"""SceneNN file formats: one module per format, with lenient readers and strict writers."""
