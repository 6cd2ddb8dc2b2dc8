"""Campaigns: many runs of a scene with other parameters, on Dask, into one Zarr store. They need Python 3.11."""

import sys

from mitransient_lidar.core.errors import UserError

if sys.version_info < (3, 11):
    raise UserError(f"campaigns need Python 3.11 or newer, which Zarr 3 needs; this is {sys.version.split()[0]}")
