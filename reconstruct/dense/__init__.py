"""The surface: `dense/`, depth of every view, fused into a DEM and a cloud."""
