"""Surfaces among Gaussians: the other shapes of a Mitsuba scene, their light, shadows and
reflections.
"""
