"""The second start of a surface: what a radiance volume shows and no hull does."""
