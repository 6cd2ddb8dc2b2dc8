"""The command line ``mitransient-lidar``."""
