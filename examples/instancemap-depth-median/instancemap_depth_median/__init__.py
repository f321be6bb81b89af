"""Refiner plugin for InstanceMap: refiner=depth_median."""
