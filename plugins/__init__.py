"""Plugins that ship with InstanceMap, one plugin per file."""
