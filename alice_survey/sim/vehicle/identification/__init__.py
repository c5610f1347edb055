"""Coefficients of a vehicle from the logs of its motion."""
