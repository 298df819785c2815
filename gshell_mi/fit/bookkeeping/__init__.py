"""What a fit keeps while it runs: checkpoint, log, progress, and how it is stopped and watched."""
