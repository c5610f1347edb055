"""Where the hull reaches lowest and farthest, for keeping it off the sea floor."""

HULL_BODY_M = (
    (1.06, 0.0, 0.0),
    (0.949, 0.0, 0.115),
    (0.0, 0.0, 0.115),
    (-0.611, 0.0, 0.115),
    (-0.90, 0.0, 0.0),
)
"""Nose, keel below it, midships and at the tail, and tail: points of ALICE's outline
(hydrodynamics/geometry.py) in the plane of symmetry. SPARUS II, 0.2 m shorter at either end or
less, lies within. What hangs below it, DVL and port, is placed by a survey's settings."""
