"""A simulated sea floor, its water and light, and a renderer that looks through a camera."""
