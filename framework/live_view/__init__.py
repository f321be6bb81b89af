"""What viewers share: a thread that draws while the loop goes on, and what there is to be drawn."""
