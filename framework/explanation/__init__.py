"""Explanation of the errors of a run: causes of lost objects, and contributions of the stages to the loss."""
