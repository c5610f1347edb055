"""Imaging settings, each with its equation and the limit that bound it."""
