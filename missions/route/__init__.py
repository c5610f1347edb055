"""The way along the lines: turns, ways round no-go zones, what flying costs, dives."""
