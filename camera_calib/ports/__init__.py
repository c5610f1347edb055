"""Ports between the lens and the water: one file each."""
