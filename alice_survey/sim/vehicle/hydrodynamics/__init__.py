"""Hydrodynamic coefficients from a vehicle's geometry, and the tables of the paper."""
