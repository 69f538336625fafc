"""Readers of capture folders, one per layout; `reader_registry.py` lists them."""
