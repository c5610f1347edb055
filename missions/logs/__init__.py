"""Logs of real and simulated vehicles, in the formats that other tools open."""
