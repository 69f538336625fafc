"""The loop around the method: its settings, and the observations of a frame."""
