"""Recordings of phones and sensors, in the formats of their apps and drivers, become RGB-D folders."""
