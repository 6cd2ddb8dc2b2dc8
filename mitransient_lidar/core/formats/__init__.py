"""Array, JSON, XML and TOML files: read within limits, and refused in one sentence."""
