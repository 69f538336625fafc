"""Multi-view recordings: cameras and synchronised frames."""
