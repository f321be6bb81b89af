"""Contract tests for all plugins. Other packages import them from `instancemap.testing`."""
