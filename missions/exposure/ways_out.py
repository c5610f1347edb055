"""What to say when limits conflict: which two do, and the cheapest ways out.

The code that finds a conflict computes the ways: each is a setting with the value that just fits
and what it costs. Costs are shares (0.3: the survey takes 30 % longer, or 30 % of what was
requested is given up), so that ways of different kinds can be put in order.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from alice_survey.base.errors import PlanError

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


def conflict(what: str, limits: tuple[str, str], ways: Sequence[Way]) -> PlanError:
    """The error that names two limits and the three cheapest ways out, in at most four lines.

    Args:
        what: what cannot be, with the numbers.
        limits: the two that conflict.
        ways: any number of them, at least one; equal costs keep their order.
    """
    if not ways:
        raise ValueError(f"a conflict needs a way out: {what}")
    cheapest = sorted(ways, key=lambda way: way.cost)[:_SHOWN]
    lines = [f"{what}: {limits[0]} conflicts with {limits[1]}; ways out, the cheapest first:"]
    lines += [f"  - {way.change}: {way.price}" for way in cheapest]
    return PlanError("\n".join(lines))
