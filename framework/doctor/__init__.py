"""Checks of the installation for `instancemap doctor`. They run even if the installation is broken."""
