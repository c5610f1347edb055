"""Lengths, areas, volumes and roughness in a survey's surface, each with its sigma."""
