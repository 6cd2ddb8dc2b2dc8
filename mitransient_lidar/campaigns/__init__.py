"""Campaigns: many runs of a scene with other parameters, on Dask, into one Zarr store."""
