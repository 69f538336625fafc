"""Decoding and rendering of streams, and visualisation of their channels."""
