"""Studies that drive many renders."""
