"""Streams decoded and rendered, and channels visualised as images."""
