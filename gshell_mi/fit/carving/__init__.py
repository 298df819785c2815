"""A fog of radiance inside the hull: finds what the hull bridges."""
