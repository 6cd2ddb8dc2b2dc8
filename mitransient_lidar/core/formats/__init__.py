"""Files of arrays, of JSON, XML and TOML: read within limits, and refused in one sentence."""
