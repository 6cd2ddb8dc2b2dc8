"""Series of shots at several places, rendered together."""
