"""One file = one command of `instancemap`; `command_line`, `experiment` and `sweep` are what they share."""
