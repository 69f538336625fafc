"""Streams as files that other programs read."""
