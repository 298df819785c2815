"""The stages of a fit: one file each, with its settings; ``pipeline.py`` puts them in their order."""
