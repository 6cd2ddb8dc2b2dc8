"""Information of records about the parameters of a scene."""
