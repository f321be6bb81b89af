"""A refiner for InstanceMap: refiner=depth_median."""
