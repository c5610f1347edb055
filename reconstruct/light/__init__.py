"""The light in which pictures were taken, solved from what several of them see."""
