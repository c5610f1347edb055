"""Hydrodynamic coefficients from geometry, beside those of the paper."""
