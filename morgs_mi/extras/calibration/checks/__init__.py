"""Checks of the poses of a recording, and the plot of its rig."""
