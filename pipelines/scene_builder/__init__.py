"""Builders of the scenes under ``scenes/``: modelling, draping, lights, files."""
