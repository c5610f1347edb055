"""The place of a model in the world: `sparse/`, the camera track and what is known of it."""
