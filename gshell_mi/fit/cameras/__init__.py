"""Which corrections of cameras and exposures the images justify."""
