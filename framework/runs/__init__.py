"""Reading and writing of run directories."""
