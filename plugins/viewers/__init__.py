"""Viewers for runs in progress."""
