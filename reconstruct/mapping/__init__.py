"""Structure from motion with COLMAP: `mapping/`, the model of all pictures in its own gauge."""
