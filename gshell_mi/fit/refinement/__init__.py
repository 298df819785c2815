"""Moves the template to where one radiance explains all images."""
