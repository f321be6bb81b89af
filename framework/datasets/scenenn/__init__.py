"""SceneNN file formats."""
