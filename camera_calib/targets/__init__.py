"""Calibration targets: what they look like, printed sheets, and their points found in pictures."""
