"""Streams in the browser."""
