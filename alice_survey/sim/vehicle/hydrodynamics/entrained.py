"""The water inside the hull, which moves along: its mass and place.

One rule for every set of coefficients: water inside counts to the rigid body's inertia and not to
its weight (its weight and its buoyancy cancel), and added mass is that of the water outside.

The paper's wet sections are the nose and the tail. How far they reach is not published, but it
follows: dry vehicle and water fill the envelope together, and what the dry vehicle displaces has
its centre at the body's origin, the centre of buoyancy. Water is taken to fill the hull from a
bulkhead to either end, and the two bulkheads are where both conditions hold. (In truth the parts in
the wet sections displace some of it, and the sections reach a little further.)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from alice_survey.core.errors import VehicleError
from alice_survey.core.frames import Array
from alice_survey.sim.vehicle.hydrodynamics.geometry import Geometry, Outline

_EXACT_M = 1e-12
_MAX_STEPS = 200


@dataclass(frozen=True, kw_only=True)
class Entrained:
    """Water inside the hull."""

    mass_kg: float
    x_m: float
    """Position of its centre, from the centre of buoyancy."""
    inertia_kg_m2: tuple[float, float, float]
    """Inertia about its own centre: roll, pitch, yaw."""
    nose_from_x_m: float
    """Bulkhead from which water fills the nose."""
    tail_to_x_m: float
    """Bulkhead up to which water fills the tail."""


def entrained_water(geometry: Geometry, buoyancy_kg: float, density: float) -> Entrained:
    """Water in the nose and tail sections.

    Args:
        geometry: the vehicle.
        buoyancy_kg: mass of the water that the drained vehicle displaces.
        density: density of the water, kg/m^3.

    Raises:
        VehicleError: the envelope has no room for it, or the bulkheads would cross.
    """
    water_m3 = geometry.envelope_volume_m3 - buoyancy_kg / density
    if water_m3 < 0:
        raise VehicleError(
            f"{geometry.name} displaces {buoyancy_kg:g} kg but its envelope holds "
            f"{density * geometry.envelope_volume_m3:.1f} kg: give a larger hull or less buoyancy"
        )
    outline = geometry.outline
    moment = geometry.envelope_volume_m3 * geometry.envelope_x_m

    def tail_bulkhead(nose_x: float) -> float:
        left = water_m3 - _moments(outline, nose_x, outline.nose_x_m)[0]
        if left <= 0:
            return outline.tail_x_m

        def missing(x: float) -> float:
            return float(_moments(outline, outline.tail_x_m, x)[0] - left)

        return _root(missing, outline.tail_x_m, nose_x)

    def unbalance(nose_x: float) -> float:
        tail = _moments(outline, outline.tail_x_m, tail_bulkhead(nose_x))[1]
        return float(tail + _moments(outline, nose_x, outline.nose_x_m)[1] - moment)

    def all_in_nose(x: float) -> float:
        return float(_moments(outline, x, outline.nose_x_m)[0] - water_m3)

    foremost = outline.nose_x_m
    aftmost = _root(all_in_nose, outline.tail_x_m, outline.nose_x_m)
    if not unbalance(aftmost) >= 0 >= unbalance(foremost):
        raise VehicleError(
            f"water in the ends of {geometry.name} cannot put the centre of buoyancy at the "
            f"origin: the envelope's centre is at x = {geometry.envelope_x_m:.3f} m"
        )
    nose_x = _root(unbalance, aftmost, foremost)
    tail_x = tail_bulkhead(nose_x)
    volume, first, second, across = _moments(outline, nose_x, outline.nose_x_m) + _moments(
        outline, outline.tail_x_m, tail_x
    )
    x = first / volume
    lengthwise = density * (second - volume * x**2 + across)
    return Entrained(
        mass_kg=float(density * volume),
        x_m=float(x),
        inertia_kg_m2=(float(2.0 * density * across), float(lengthwise), float(lengthwise)),
        nose_from_x_m=nose_x,
        tail_to_x_m=tail_x,
    )


def _root(function: Callable[[float], float], low: float, high: float) -> float:
    """Root of a function between two places, to 1e-12 m.

    The Illinois rule of false position (Dowell & Jarratt, 1971). scipy's solvers would do, but take
    a tenth of a second to load, at every start of a command that plans.
    """
    at_low, at_high = function(low), function(high)
    for _ in range(_MAX_STEPS):
        if at_high == 0.0 or abs(high - low) <= _EXACT_M:
            break
        place = high - at_high * (high - low) / (at_high - at_low)
        value = function(place)
        if value * at_high <= 0.0:
            low, at_low = high, at_high
        else:
            at_low /= 2.0
        high, at_high = place, value
    return high


def _moments(outline: Outline, aft_x: float, fore_x: float) -> Array:
    """Volume, its first and second moment about x = 0, and the integral of pi r^4 / 4."""
    if fore_x <= aft_x:
        return np.zeros(4)
    x, r, w = outline.strips(breaks_m=(aft_x, fore_x))
    within = (x > aft_x) & (x < fore_x)
    x, area, w = x[within], np.pi * r[within] ** 2, w[within]
    across = area**2 / (4.0 * np.pi)
    return np.array([np.sum(w * f) for f in (area, area * x, area * x**2, across)])
