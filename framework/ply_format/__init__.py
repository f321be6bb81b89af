"""The parts of a PLY file: its header, and its rows as bytes or as text."""
