"""Generative models of open surfaces: data sets, encodings, models, sampling and scores.

``torch`` is imported by the modules ``models``, ``training`` and ``sampling`` alone, and these run in
processes of their own: its threads and Dr.Jit's slow each other down. It comes with the extra ``[generate]``.
"""
