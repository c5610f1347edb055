"""Field of view, focus, stereo and blur behind a flat port, and the paper's values."""
