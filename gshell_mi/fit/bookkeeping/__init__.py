"""What a fit keeps of itself: checkpoints, fingerprints of its inputs; and what those see who watch it."""
