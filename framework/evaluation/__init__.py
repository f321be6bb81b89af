"""How good a map and a trajectory are, measured against what is true."""
