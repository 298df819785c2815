"""``python -m gshell_mi.train``: a generative model learns a data set."""
