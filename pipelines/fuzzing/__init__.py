"""Damaged inputs for everything that reads files: how they are made, and what is done with them."""
