"""Cameras behind flat ports: models, rigs, tables, calibration."""
