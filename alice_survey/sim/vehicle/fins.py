"""Fins: control surfaces that steer a vehicle under way, by the lift of the water that meets them.

A fin turns about a shaft. At an angle delta its chord is the body's x axis turned about the shaft,
and the water meets it at the angle of attack alpha between its chord and its own velocity through
the water, that of the vehicle's rotation included:

    V = v + omega x r,   alpha = atan2(-V . normal, V . chord)

Lift is perpendicular to V in the plane of chord and normal, drag against V, on the part of V in
that plane (S. F. Hoerner, Fluid-Dynamic Lift, 1975; T. Prestero, MSc thesis, MIT and WHOI, 2001,
chapter 4):

    C_L = a alpha,                    C_D = C_D0 + C_L^2 / (pi e AR)          attached
    C_L = C_N sin(alpha) cos(alpha),  C_D = C_D0 + C_N sin^2(alpha)           stalled: a flat plate

with a = 1 / (1 / (2 pi 0.9) + 1 / (pi AR)) where it is not given. Attached flow goes over into
stalled flow smoothly over `_STALLS_OVER_RAD`. Fins on one shaft, or linked, turn together.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat
from pydantic.dataclasses import dataclass

from alice_survey.core.compiled import kernel
from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.propulsion import FILE_PART

_SECTION_SHARE = 0.9
"""Lift slope of a section over the 2 pi of theory (Hoerner; Prestero 2001, equation 4.46)."""
_OSWALD = 0.9
"""e, by which lift spread unevenly over the span induces more drag (inferred)."""
_STALLS_OVER_RAD = math.radians(10.0)
"""Attached flow goes over into stalled flow between the stall and this much more (inferred)."""


@dataclass(frozen=True, kw_only=True, config=FILE_PART)
class Fin:
    """One fin, or several that turn together, each of the same shape.

    Raises:
        ValidationError: a number is not physical.
        VehicleError: the shaft is not square to x.
    """

    name: str
    positions_body_m: Annotated[tuple[tuple[float, float, float], ...], Field(min_length=1)]
    """Where the lift of each acts: its quarter chord, half way along its span."""
    shaft_body: tuple[float, float, float]
    """Unit vector about which a positive angle turns them, by the right hand; square to x."""
    area_m2: PositiveFloat
    """Of one of them, seen along its normal."""
    aspect_ratio: PositiveFloat
    """Span squared by area; of a fin on a hull that mirrors it, twice that of what is seen."""
    most_angle_deg: Annotated[float, Field(gt=0, le=90)]
    most_rate_deg_s: PositiveFloat
    time_constant_s: PositiveFloat = 0.1
    """Lag of the drive."""
    lift_slope_per_rad: PositiveFloat | None = None
    """dC_L / d alpha; of the aspect ratio if not given."""
    stall_deg: Annotated[float, Field(gt=0, lt=60)] = 20.0
    profile_drag: NonNegativeFloat = 0.0
    """C_D0; 0 where the hull's X_uu has it."""
    plate_drag: NonNegativeFloat = 0.56
    """C_N, the drag coefficient square to the flow: 0.1 + 0.7 t of a taper ratio t (Prestero)."""

    def __post_init__(self) -> None:
        shaft = self.shaft_body
        if not (abs(math.hypot(*shaft) - 1.0) < 1e-6 and abs(shaft[0]) < 1e-6):
            raise VehicleError(
                f"shaft_body {shaft} of fin {self.name!r} is not a unit vector square to x: the "
                "fin's chord lies along x when it is not turned"
            )

    @property
    def slope(self) -> float:
        """dC_L / d alpha, per radian."""
        if self.lift_slope_per_rad is not None:
            return self.lift_slope_per_rad
        return 1.0 / (1.0 / (2.0 * math.pi * _SECTION_SHARE) + 1.0 / (math.pi * self.aspect_ratio))


# Columns of `Fins.surfaces`.
PLACE, SHAFT, NORMAL = 0, 3, 6
"""Three columns each: where it is, its shaft, and the normal while it is not turned; the chord is
then x."""
PRESSURE = 9
"""1/2 rho A, N per (m/s)^2."""
SLOPE, STALL, PROFILE, INDUCED, PLATE = 10, 11, 12, 13, 14
"""a; rad; C_D0; 1 / (pi e AR); C_N."""
DRIVE = 15
"""Index of the drive that turns it."""
SURFACE_COLUMNS = 16
# Columns of `Fins.drives`.
MAX_RAD, MAX_RAD_S, LAG_RATE = 0, 1, 2
"""Greatest angle, rad, either way, and rate, rad/s; 1 / lag, 1/s."""


class Fins(NamedTuple):
    """Fins for compiled code."""

    surfaces: Array
    """(S, SURFACE_COLUMNS), a row a surface."""
    drives: Array
    """(m, 3), a row a drive: what turns one or more surfaces."""


def pack_fins(fins: Sequence[Fin], density: float) -> Fins:
    """Fins for compiled code, in water of a density, kg/m^3."""
    rows = []
    for index, fin in enumerate(fins):
        for place in fin.positions_body_m:
            row = np.zeros(SURFACE_COLUMNS)
            row[PLACE : PLACE + 3], row[SHAFT : SHAFT + 3] = place, fin.shaft_body
            row[NORMAL : NORMAL + 3] = np.cross(fin.shaft_body, [1.0, 0.0, 0.0])
            row[PRESSURE] = 0.5 * density * fin.area_m2
            row[[SLOPE, STALL]] = fin.slope, math.radians(fin.stall_deg)
            row[[PROFILE, PLATE]] = fin.profile_drag, fin.plate_drag
            row[INDUCED] = 1.0 / (math.pi * _OSWALD * fin.aspect_ratio)
            row[DRIVE] = index
            rows.append(row)
    drives = [
        (math.radians(f.most_angle_deg), math.radians(f.most_rate_deg_s), 1.0 / f.time_constant_s)
        for f in fins
    ]
    return Fins(
        np.array(rows).reshape(-1, SURFACE_COLUMNS), np.array(drives, np.float64).reshape(-1, 3)
    )


@kernel
def add_fins(fins: Fins, angles: Array, nu: Array, force: Array) -> None:
    """Add the wrench of all fins to a force (6,).

    Args:
        fins: of m drives.
        angles: (m,) rad.
        nu: (6,) velocity relative to the water.
        force: (6,) is added to.
    """
    s = fins.surfaces
    u, v, w, p, q, r = nu[0], nu[1], nu[2], nu[3], nu[4], nu[5]
    for i in range(s.shape[0]):
        x, y, z = s[i, PLACE], s[i, PLACE + 1], s[i, PLACE + 2]
        a, b, c = u + q * z - r * y, v + r * x - p * z, w + p * y - q * x
        angle = angles[int(s[i, DRIVE])]
        sine, cosine = math.sin(angle), math.cos(angle)
        # The normal has no part along x, the chord none but x while the fin is not turned.
        n_y, n_z = s[i, NORMAL + 1], s[i, NORMAL + 2]
        across = n_y * b + n_z * c
        along_chord = cosine * a + sine * across
        along_normal = cosine * across - sine * a
        square = along_chord * along_chord + along_normal * along_normal
        if square == 0.0:
            continue
        alpha = math.atan2(-along_normal, along_chord)
        lift = s[i, SLOPE] * alpha
        drag = s[i, INDUCED] * lift * lift
        beyond = (abs(alpha) - s[i, STALL]) / _STALLS_OVER_RAD
        if beyond > 0.0:
            share = min(beyond, 1.0)
            share *= share * (3.0 - 2.0 * share)
            sine, cosine = math.sin(alpha), math.cos(alpha)
            lift += share * (s[i, PLATE] * sine * cosine - lift)
            drag += share * (s[i, PLATE] * sine * sine - drag)
        drag += s[i, PROFILE]
        pressure = s[i, PRESSURE] * math.sqrt(square)
        # Lift is V turned by a right angle, from the chord towards the normal; drag is against V.
        f_x = pressure * (-lift * across - drag * a)
        f_n = pressure * (lift * a - drag * across)
        f_y, f_z = f_n * n_y, f_n * n_z
        force[0] += f_x
        force[1] += f_y
        force[2] += f_z
        force[3] += y * f_z - z * f_y
        force[4] += z * f_x - x * f_z
        force[5] += x * f_y - y * f_x


@kernel
def write_fin_matrix(fins: Fins, nu: Array, out: Array, first: int) -> None:
    """Write the wrench per angle, (6, m) N and N m per rad, of fins that are not turned.

    A fin that the water meets from behind is not counted on: zero.

    Args:
        fins: of m drives.
        nu: (6,) velocity relative to the water as far as it is known.
        out: (6, first + m), whose last m columns are written.
        first: column of the first drive.
    """
    s = fins.surfaces
    for j in range(fins.drives.shape[0]):
        for axis in range(6):
            out[axis, first + j] = 0.0
    for i in range(s.shape[0]):
        x, y, z = s[i, PLACE], s[i, PLACE + 1], s[i, PLACE + 2]
        ahead = nu[0] + nu[4] * z - nu[5] * y
        if ahead <= 0.0:
            continue
        f_n = s[i, PRESSURE] * s[i, SLOPE] * ahead * ahead
        f_y, f_z = f_n * s[i, NORMAL + 1], f_n * s[i, NORMAL + 2]
        column = first + int(s[i, DRIVE])
        out[1, column] += f_y
        out[2, column] += f_z
        out[3, column] += y * f_z - z * f_y
        out[4, column] -= x * f_z
        out[5, column] += x * f_y


def fin_slope(fins: Fins, nu: Array) -> Array:
    """(6, 6) slope, by velocity, of the force that fins at rest take from the water: of -F.

    As `linear.linear_damping`, which has the hull's; by central differences.
    """
    slope, step = np.zeros((6, 6)), 1e-5
    angles = np.zeros(len(fins.drives))
    for column in range(6):
        ends = []
        for sign in (1.0, -1.0):
            force, moved = np.zeros(6), np.array(nu, dtype=np.float64)
            moved[column] += sign * step
            add_fins(fins, angles, moved, force)
            ends.append(force)
        slope[:, column] = -(ends[0] - ends[1]) / (2.0 * step)
    return slope
