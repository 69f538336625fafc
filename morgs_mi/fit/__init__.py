"""The optimisation: the first frame, every later frame, and density control."""
