"""Information in records about scene parameters: error bounds, and fits."""
