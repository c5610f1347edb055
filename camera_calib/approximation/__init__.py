"""Simpler cameras in place of a flat port, their errors, and correction of dispersion."""
