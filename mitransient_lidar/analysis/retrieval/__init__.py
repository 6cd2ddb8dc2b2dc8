"""Sea slope, depth, bottom and water from echoes."""
