"""Information of records about the parameters of a scene: bounds of errors, and fits."""
