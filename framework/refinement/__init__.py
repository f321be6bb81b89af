"""What cluster refiners share: the neighborhood of each mask, and mixtures fitted to it."""
