"""Commands that inspect and extend the installation."""
