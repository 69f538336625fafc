"""Fits of scenes while they happen: the newest synchronous images of live cameras, calibrated once."""
