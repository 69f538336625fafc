"""Measures of an evaluation that need a network."""
