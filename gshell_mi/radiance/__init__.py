"""Radiance of what has no surface yet: what the images say before there is a material and a light."""
