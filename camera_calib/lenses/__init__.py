"""Lenses in air: one file each."""
