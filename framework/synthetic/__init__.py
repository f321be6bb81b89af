"""Synthetic furnished rooms: furniture, layout, light, camera trajectory and depth sensor."""
