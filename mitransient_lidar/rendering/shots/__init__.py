"""Series of shots at several locations, rendered together."""
