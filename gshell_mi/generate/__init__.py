"""``python -m gshell_mi.generate``: new open meshes from a trained model."""
