"""Readers of capture folders, one per layout; `registry.py` lists them."""
