"""Radiance without light or material: finds the openings of the hull."""
