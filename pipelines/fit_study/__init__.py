"""Studies over many fits: runs that can be interrupted, scores, tables."""
