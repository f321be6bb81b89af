"""Plugins that are part of InstanceMap, one per file."""
