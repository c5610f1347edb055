"""One stereo station by itself: a cloud, a mesh, and lengths between picked pixels."""
