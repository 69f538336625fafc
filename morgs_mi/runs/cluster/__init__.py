"""Fits in many processes, on one machine or on a Dask cluster: chunks of a recording."""
