"""Fits of captures, with their files."""
