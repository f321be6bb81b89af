"""What these pages need beside sphinx's own: pages that are made from the code, and formulas without a network."""
