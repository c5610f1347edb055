"""Calibration targets: their layouts, printed sheets, and detection of their points."""
