"""``python -m gshell_mi.batch``: many commands of this package, on one machine or on a Ray cluster."""
