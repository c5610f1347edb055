"""A picture in a model: lens, pose, where a point is seen."""
