"""Foundations of all subpackages: cameras, Gaussians, the attribute table, colour spaces, atomic
files.
"""
