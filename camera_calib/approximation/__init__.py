"""Simpler cameras in place of a flat port, what they cost, and the port's dispersion undone."""
