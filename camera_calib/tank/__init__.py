"""Fixed cameras that look into water through one flat interface: poses, points, plots."""
