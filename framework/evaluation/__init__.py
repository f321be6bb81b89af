"""How good a result is: instance average precision, trajectory error, agreement of labels."""
