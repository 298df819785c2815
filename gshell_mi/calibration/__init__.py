"""Corrections of what is said of cameras: poses, fields of view and exposures, from images of one surface."""
