"""Integrators whose gradients include the motion of silhouettes; registered as Mitsuba plugins.

The modules ``gshell_path`` and ``gshell_mask`` define plugin classes and are loaded by
``plugins`` once a variant is set; nothing here imports them.
"""
