"""Import of ROS bags."""
