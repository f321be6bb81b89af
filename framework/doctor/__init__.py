"""Checks of the installation, as printed by `instancemap doctor`. Nothing here needs a working installation."""
