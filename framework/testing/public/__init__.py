"""The submodules of `instancemap`, which is a single file: instancemap.py sets `__path__` to this folder."""
