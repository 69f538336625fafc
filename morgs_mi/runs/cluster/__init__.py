"""Fits in many processes, on one machine or on a Dask cluster: segments of a recording."""
