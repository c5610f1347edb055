"""What to say when limits conflict: which two do, and the cheapest ways out.

The code that finds a conflict computes the ways: each is a setting with the value that just fits
and what it costs. Costs are shares (0.3: the survey takes 30 % longer, or 30 % of what was
requested is given up), so that ways of different kinds can be put in order.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from alice_survey.base.config import PlanConfig
from alice_survey.base.errors import PlanError

LEAST_ALTITUDE_M, HIGHEST_ALTITUDE_M = 0.3, 10.0
"""Altitudes of the glass over any ground that `plan.altitude_m` allows."""
_SHOWN = 3


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way out of a conflict."""

    change: str
    """The setting and the value that fits, such as `speed_mps 0.12 instead of 0.2`."""
    price: str
    """What is lost by it, in words and numbers."""
    cost: float
    """Loss as a share: extra time of the survey, or what is given up of what was requested."""


def conflict(what: str, limits: tuple[str, str], ways: Iterable[Way]) -> PlanError:
    """The error that names two limits and the three cheapest ways out, in at most four lines.

    Args:
        what: what cannot be, with the numbers.
        limits: the two that conflict.
        ways: any number of them, at least one; equal costs keep their order.
    """
    cheapest = sorted(ways, key=lambda way: way.cost)[:_SHOWN]
    if not cheapest:
        raise ValueError(f"a conflict needs a way out: {what}")
    lines = [f"{what}: {limits[0]} conflicts with {limits[1]}; ways out, the cheapest first:"]
    lines += [f"  - {way.change}: {way.price}" for way in cheapest]
    return PlanError("\n".join(lines))


def less_overlap(plan: PlanConfig, reached: float, also: str = "", kept: str = "") -> Iterator[Way]:
    """The way out to be content with the forward overlap that is reached, if any is.

    Args:
        plan: as set.
        reached: forward overlap.
        also: another change that it takes.
        kept: what this keeps.
    """
    if reached <= 0:
        return
    shown = math.floor(1000 * reached + 1e-6) / 1000
    yield Way(
        change=f"{also}forward_overlap {shown:g} instead of {plan.forward_overlap:g}",
        price=f"{kept}a point is seen {1 / (1 - shown):.1f} instead of "
        f"{1 / (1 - plan.forward_overlap):.1f} times on a line",
        cost=1.0 - (1.0 - plan.forward_overlap) / (1.0 - shown),
    )


def least_that_fits(fits: Callable[[float], bool], low: float, high: float) -> float | None:
    """Least value that fits, where all above it do; None where the highest does not."""
    if not fits(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
