"""Cameras that are not quite where they are said to be, corrected by what the views agree on."""
