"""Light that water scatters forward: what of it still lights the floor and reaches the camera.

Scattering turns most light by a few degrees only. Turned by the angle t somewhere on its way, it
is lost to the spot or the pixel that it was sent to, but neighbours' light arrives in its place. Of
light scattered once, the share that arrives is, averaged over the place of the turn:

- on a level floor, from a strobe that shines as the cosine of its angle: `pi integral p(t) (sin t +
  t cos t) dt` from 0 to 90 degrees. In the plane through strobe, turn and spot, with the angles u
  and v of the light's two legs against the straight line between strobe and spot, u + v = t, a
  volume `dV / (r1^2 r2^2) = du dv dphi / d`, and intensity and incidence are weakened by cos u and
  cos v on average over phi; the integral of cos u cos v over u is half the bracket.
- in a camera that looks down on that floor, lit as cos^4 by a strobe at its side: `pi integral p(t)
  cos t (sin t cos t + t) dt`, as the floor is darker where turned light comes from.

Turns follow each other independently (small angles; Wells 1973, AGARD LS-61), so that n turns keep
the n-th power, and a path x that has `exp(-c x)` of its light unscattered has `exp(-(c - share b)
x)` in all: the form of Gordon's quasi-single scattering (1973, Applied Optics 12, 2803). Longer
ways of turned light are left out. A Monte Carlo of photons judges it in `tests/missions/exposure`.

What is turned on its way from the floor lights a pixel with its neighbours' light: it counts in
electrons, and blurs; only what stays within the pixel's own cone is detail.
"""

import math

import numpy as np

from camera_calib.water import ASYMMETRY, phase_per_sr

_ANGLES = np.linspace(0.0, math.pi / 2, 20_001)
_PHASE = phase_per_sr(np.cos(_ANGLES))

LIT_SHARE = float(
    math.pi * np.trapezoid(_PHASE * (np.sin(_ANGLES) + _ANGLES * np.cos(_ANGLES)), _ANGLES)
)
"""Share of the scattered light of a strobe that still lights the floor where it would have."""
SEEN_SHARE = float(
    math.pi
    * np.trapezoid(
        _PHASE * np.cos(_ANGLES) * (np.sin(_ANGLES) * np.cos(_ANGLES) + _ANGLES), _ANGLES
    )
)
"""Share of the scattered light of the floor that a pixel's neighbours give it back."""


def share_within(angle_rad: float) -> float:
    """Share of scattered light that is turned by less than an angle (Henyey-Greenstein)."""
    g = ASYMMETRY
    # 1 + g^2 - 2 g cos without its cancellation at small angles.
    far = math.sqrt((1.0 - g) ** 2 + 4.0 * g * math.sin(angle_rad / 2) ** 2)
    return (1.0 - g * g) / (2.0 * g) * (far - (1.0 - g)) / (far * (1.0 - g))
