"""Flights: from the poses of pulses over a seabed to points with errors."""
