"""Drag coefficients from shape.

The paper prints C_f with a minus and X_uu with u |u| on its right side; here C_f is positive and
X_uu = -1/2 rho A C_d is a coefficient.
"""

import math

CYLINDER_CD = 1.2
"""C_d0 of a long cylinder across the flow, subcritical (paper)."""
LONG_CYLINDER = 57.5
"""l / d from which end effects are negligible (paper, after Uematsu and Yamada 1995)."""
TUNNEL_CBTO = 0.012
"""C_BTO of a thruster tunnel with sharp edges off the middle of a bow: the upper end of 0.003 to
0.012 (Holtrop and Mennen 1982, International Shipbuilding Progress 29)."""


def ittc57(reynolds: float) -> float:
    """C_f = 0.075 / (log10 Re - 2)^2, the ITTC-1957 line. As printed: with a minus."""
    return 0.075 / (math.log10(reynolds) - 2.0) ** 2


def ellipsoid_axial(length_m: float, diameter_m: float, friction: float) -> float:
    """C_d by frontal area of an ellipsoid along its axis (Hoerner 1965; paper).

    0.44 d / l + 4 C_f l / d + 4 C_f (d / l)^(1/2).
    """
    slim = diameter_m / length_m
    return 0.44 * slim + 4.0 * friction / slim + 4.0 * friction * math.sqrt(slim)


def cylinder_across(fineness: float) -> float:
    """C_d by silhouette of a cylinder of finite l / d across the flow (Uematsu and Yamada 1995).

    1.2 (0.58 + 0.17 log10(l / d)^1.6) up to l / d = 57.5, 1.2 beyond.
    """
    if fineness > LONG_CYLINDER:
        return CYLINDER_CD
    return CYLINDER_CD * (0.58 + 0.17 * math.pow(math.log10(max(fineness, 1.0)), 1.6))


def plate_across(aspect: float) -> float:
    """C_d of a rectangular plate across the flow.

    1.10 + 0.02 (a + 1 / a), a fit in common use to the plates of Hoerner (1965, chapter 3), up to
    an aspect ratio of 30; its source could not be read. On a wall a plate counts with its
    mirror image: twice its height over its width.
    """
    return 1.10 + 0.02 * (aspect + 1.0 / aspect)


def strut_along(chord_m: float, width_m: float, reynolds: float) -> float:
    """C_d by frontal area of a strut of elliptic section along its chord, subcritical.

    2 C_f (1 + c / t) + 1.1 t / c (Hoerner 1965, chapter 6), with laminar C_f = 1.328 / sqrt(Re)
    (Blasius, one side).

    Args:
        chord_m: c, along the flow.
        width_m: t, across it.
        reynolds: by the chord.
    """
    friction = 1.328 / math.sqrt(reynolds)
    slim = width_m / chord_m
    return 2.0 * friction * (1.0 + 1.0 / slim) + 1.1 * slim


def tunnel_area(diameter_m: float) -> float:
    """C_d A of a tunnel's two mouths, m^2: R = rho u^2 pi d^2 C_BTO (Holtrop and Mennen 1982)."""
    return 2.0 * math.pi * diameter_m**2 * TUNNEL_CBTO
