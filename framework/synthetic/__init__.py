"""Synthetic scenes: furniture, layout, light, camera trajectory and depth sensor."""
