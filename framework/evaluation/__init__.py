<<<<<<< HEAD
"""How good a result is: instance average precision, trajectory error, agreement of labels."""
=======
"""How good a map and a trajectory are, measured against what is true."""
>>>>>>> refiners
