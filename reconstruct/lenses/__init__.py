"""How pixels as taken and those of the ideal pinholes of a model belong together."""
