"""Watertight templates and the mSDF that cuts them: rims, sheets, movement, and what nobody sees.

Knows lattices, fields and meshes, and nothing of a fit.
"""
