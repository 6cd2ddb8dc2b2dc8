"""Shot series at several locations, rendered together."""
