"""Sphinx extensions: reference pages generated from the code, and formulas without network access."""
