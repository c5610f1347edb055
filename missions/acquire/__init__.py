"""From a track to pictures, simulated."""
