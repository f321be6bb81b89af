"""Sphinx extensions: reference pages generated from the code, formulas without network access, and checks of pages."""
