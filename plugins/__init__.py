"""Mitsuba plugins of the lidar simulator, one a file; run again for every variant that is set."""
