"""Calibrate a rig from views of a target: start, joint adjustment, outliers, advice, files."""
