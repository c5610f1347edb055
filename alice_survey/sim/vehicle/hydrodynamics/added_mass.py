"""Added mass from shape: ellipsoids along their axis, strips across it.

Where the paper's printed form is wrong, the right one is computed and the printed one is kept as
a function or a comment next to it.
"""

import math

import numpy as np

from alice_survey.core.frames import Array


def alpha_0(length_m: float, diameter_m: float) -> float:
    """Lamb's constant of a prolate spheroid along its axis (Lamb 1932; Fossen 2011).

    alpha_0 = 2 (1 - e^2) / e^3 (1/2 ln((1 + e) / (1 - e)) - e), e = sqrt(1 - (d / l)^2).
    As printed in the paper: e = 1 - (d / l)^2, and (l / 2) ln, a length in a pure number.
    2/3 for a sphere, 0 for a needle.
    """
    squared = 1.0 - (diameter_m / length_m) ** 2
    if squared < 1e-6:
        # The closed form loses its digits near a sphere: its series in e^2.
        return 2.0 * (1.0 - squared) * (1.0 / 3.0 + squared / 5.0)
    return _alpha(math.sqrt(squared))


def _alpha(e: float) -> float:
    return 2.0 * (1.0 - e**2) / e**3 * (0.5 * math.log((1.0 + e) / (1.0 - e)) - e)


def ellipsoid_mass(length_m: float, diameter_m: float, density: float) -> float:
    """m_e = 4/3 pi rho (l/2) (d/2)^2, kg: mass of the water that the spheroid displaces."""
    return 4.0 / 3.0 * math.pi * density * length_m / 2.0 * (diameter_m / 2.0) ** 2


def ellipsoid_axial(length_m: float, diameter_m: float, density: float) -> float:
    """Added mass of a prolate spheroid along its axis, kg: alpha_0 / (2 - alpha_0) m_e."""
    alpha = alpha_0(length_m, diameter_m)
    return alpha / (2.0 - alpha) * ellipsoid_mass(length_m, diameter_m, density)


def circle_section(radius_m: Array, density: float) -> Array:
    """Added mass of circular sections moving across, kg/m: rho pi r^2 (Fossen 2011; Newman)."""
    return density * np.pi * np.asarray(radius_m, dtype=np.float64) ** 2


def finned_circle_section(radius_m: Array, span_m: float, density: float) -> Array:
    """Added mass of a circle with two fins, moving at a right angle to them, kg/m.

    rho pi (b^2 - r^2 + r^4 / b^2), Newman (1977, table 4.3). As printed in the paper:
    pi rho (b^2 - r^2) / b^2, which is not a mass per length.

    Args:
        radius_m: radius of the circle.
        span_m: distance from the middle to the tip of a fin, not below the radius.
        density: kg/m^3.
    """
    r2, b2 = np.asarray(radius_m, dtype=np.float64) ** 2, span_m**2
    return density * np.pi * (b2 - r2 + r2**2 / b2)


def finned_circle_roll(radius_m: Array, span_m: float, density: float) -> Array:
    """Added inertia in roll of a circle with two fins, kg m^2/m (Newman 1977, table 4.3).

    rho r^4 ((2 a^2 - a sin 4a + sin^2(2a) / 2) / (pi sin^4 a) - pi / 2), sin a = 2 r b / (r^2 +
    b^2), a between pi / 2 and pi. Zero without fins, rho pi b^4 / 8 of the fins alone.
    """
    r = np.asarray(radius_m, dtype=np.float64)
    sine = 2.0 * r * span_m / (r**2 + span_m**2)
    a = np.pi - np.arcsin(np.clip(sine, 0.0, 1.0))
    bracket = 2.0 * a**2 - a * np.sin(4.0 * a) + 0.5 * np.sin(2.0 * a) ** 2
    return density * r**4 * (bracket / (np.pi * sine**4) - np.pi / 2.0)


def elliptic_section(across_m: float, density: float) -> float:
    """Added mass of an elliptic section, kg/m: rho pi / 4 of its square width across the flow.

    The paper's mast: (1/4) pi rho w_m^2 h_m in surge, (1/4) pi rho c_m^2 h_m in sway.
    """
    return density * math.pi / 4.0 * across_m**2
