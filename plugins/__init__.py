"""The plugins that ship with InstanceMap: one file, one plugin."""
