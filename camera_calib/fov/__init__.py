"""Field of view, focus, stereo and blur behind a flat port, and what the paper says of them."""
