"""Furnished rooms made in memory: furniture, layout, light, camera walk and depth sensor."""
