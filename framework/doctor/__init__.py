"""What of the things that InstanceMap can use is there on this machine: what `doctor` says.

Nothing here is imported that may be missing or broken, but where that is looked at: the standard library does the rest.
"""
