"""Execution of the loop in threads."""
