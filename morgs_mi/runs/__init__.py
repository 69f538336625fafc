"""Whole jobs: fits of captures, live fits, chunks on several machines, imports, the
demonstration.
"""
