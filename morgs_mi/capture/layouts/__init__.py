"""Readers of capture folders, one per layout; `layout_registry.py` lists them."""
