"""Places in the vector of the navigation's estimate, which the pilot steers by."""

NORTH, EAST, DEPTH = 0, 1, 2
"""Position of the body's origin, metres in NED."""
ROLL, PITCH, HEADING = 3, 4, 5
"""Attitude, radians; heading is not wrapped."""
U, V, W = 6, 7, 8
"""Velocity over ground in the body frame, m/s."""
P, Q, R = 9, 10, 11
"""Body rates, rad/s."""
ALTITUDE = 12
"""Altitude of the followed point (the left port's glass), metres; NaN without bottom
lock."""
CLEARANCE = 13
"""Least height, metres, of hull, port and DVL above the plane that the DVL's beams meet, and of
the highest of those points above the lowest of the hull, minus one sigma; NaN with the altitude."""
ESTIMATE = 14
"""Length of the vector."""
