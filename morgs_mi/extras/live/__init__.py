"""Live cameras: fits of the newest synchronous images, calibrated once, and frames for a loop of
one's own.
"""
