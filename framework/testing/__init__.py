"""Contract tests that every plugin inherits. Other packages import them from `instancemap.testing`."""
