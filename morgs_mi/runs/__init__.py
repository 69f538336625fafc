"""Whole jobs: fits of captures, live fits, segments on several machines, imports, the
demonstration.
"""
