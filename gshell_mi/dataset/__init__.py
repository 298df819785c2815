"""``python -m gshell_mi.dataset``: meshes, fits or generated garments become a data set."""
