"""Mitsuba plugins of the lidar simulator, one a file, executed again for every variant that is set."""
