"""The last adjustment of stations, points and rig, on exact rays, and how well they are known."""
