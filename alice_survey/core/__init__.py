"""Foundations used everywhere: errors, frames, settings, stages, files."""
