"""Run records become the paper's figures."""
