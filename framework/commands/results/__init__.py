"""Commands that evaluate, export and visualize stored runs."""
