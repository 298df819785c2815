"""Hollows: what a radiance volume in the hull, or walls behind openings, show of what the hull bridges."""
