"""Readers and writers of stored detections."""
