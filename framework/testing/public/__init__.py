"""Submodules of `instancemap`. instancemap.py sets its `__path__` to this folder."""
