"""Light by maps of the beam at several depths, without random walks."""
