"""What to say when limits conflict: which two do, and the cheapest ways out.

The code that finds a conflict computes the ways: each is a setting with the value that just fits
and what it costs. Costs are shares (0.3: the survey takes 30 % longer, or 30 % of what was
requested is given up), so that ways of different kinds can be put in order. Who plans tries them
before they are offered (`with_ways_that_work`): what fits one limit may break another.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from alice_survey.core.config import PlanConfig
from alice_survey.core.errors import AliceError, PlanError

MIN_ALTITUDE_M, HIGHEST_ALTITUDE_M = 0.3, 10.0
"""Altitudes of the glass over any ground that `plan.altitude_m` allows."""
MAX_BLUR_PX = 20.0
"""That `plan.allowed_blur_px` and `plan.sharp_px` allow."""
_SHOWN = 3

Settings = Mapping[str, Any]
"""Values by names such as `plan.speed_mps`."""


@dataclass(frozen=True, kw_only=True)
class Way:
    """A way out of a conflict."""

    change: str
    """The setting and the value that fits, such as `speed_mps 0.12 instead of 0.2`."""
    price: str
    """What is lost by it, in words and numbers."""
    cost: float
    """Loss as a share: extra time of the survey, or what is given up of what was requested."""
    settings: Settings
    """The change as it is tried."""

    def then(self, more: "Way") -> "Way":
        """This way and another."""
        return Way(
            change=f"{self.change} and {more.change}",
            price=f"{self.price}; {more.price}",
            cost=self.cost + more.cost,
            settings={**self.settings, **more.settings},
        )


class ConflictError(PlanError):
    """Two limits that no plan meets both, with ways out."""

    what: str
    limits: tuple[str, str]
    ways: tuple[Way, ...]
    """The cheapest first."""


def conflict(what: str, limits: tuple[str, str], ways: Iterable[Way]) -> ConflictError:
    """The error that names two limits and the three cheapest ways out, in at most four lines.

    Args:
        what: what cannot be, with the numbers.
        limits: the two that conflict.
        ways: any number of them; equal costs keep their order.
    """
    cheapest = tuple(sorted(ways, key=lambda way: way.cost))
    lines = [f"{what}: {limits[0]} conflicts with {limits[1]}"]
    if cheapest:
        lines[0] += "; ways out, the cheapest first:"
    lines += [f"  - {way.change}: {way.price}" for way in cheapest[:_SHOWN]]
    found = ConflictError("\n".join(lines))
    found.what, found.limits, found.ways = what, limits, cheapest
    return found


def with_ways_that_work(found: ConflictError, plan: Callable[[Settings], object]) -> ConflictError:
    """The same conflict with three ways at most, of which each was tried.

    A way that meets another conflict is offered together with the cheapest way out of that one.

    Args:
        found: the conflict.
        plan: plans with settings changed; raises an `AliceError` where that cannot be.
    """
    working: list[Way] = []
    for way in found.ways:
        if len(working) == _SHOWN:
            break
        try:
            plan(way.settings)
        except ConflictError as next_found:
            joined = (
                way.then(more)
                for more in next_found.ways
                if way.settings.keys().isdisjoint(more.settings)
            )
            working += next(([one] for one in joined if _goes(plan, one)), [])
        except AliceError:
            pass
        else:
            working.append(way)
    if found.ways and not working:
        tried = ", ".join(dict.fromkeys(name for way in found.ways for name in way.settings))
        limits = (found.limits[0], f"{found.limits[1]}, and no value of one of {tried} is enough")
        return conflict(found.what, limits, ())
    return conflict(found.what, found.limits, working)


def _goes(plan: Callable[[Settings], object], way: Way) -> bool:
    try:
        plan(way.settings)
    except AliceError:
        return False
    return True


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
        settings={"plan.forward_overlap": shown},
    )


def min_that_fits(fits: Callable[[float], bool], low: float, high: float) -> float | None:
    """Least value that fits, where all above it do; None where the highest does not."""
    if not fits(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
