"""Things to put into a room, and what stands together."""
