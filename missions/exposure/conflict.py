"""Two limits that no plan meets both, and the value of one setting that does."""

from collections.abc import Callable

from alice_survey.core.config import SurveyConfig, change_section
from alice_survey.core.errors import ConfigError, PlanError

MIN_ALTITUDE_M, MAX_ALTITUDE_M = 0.3, 10.0
"""Altitudes of the glass over any ground that `plan.altitude_m` allows."""


class ConflictError(PlanError):
    """Two limits that no plan meets both."""

    limits: tuple[str, str]
    suggestion: tuple[str, float] | None
    """A setting such as `plan.speed_mps` and the value that just fits; None where there is none."""


def conflict(
    what: str, limits: tuple[str, str], setting: str = "", value: float | None = None
) -> ConflictError:
    """The error that names two limits, and a setting with the value that fits both.

    Args:
        what: what cannot be, with the numbers.
        limits: the two that conflict.
        setting: name of the setting to change.
        value: that just fits; not suggested where the setting cannot have it.
    """
    text = f"{what}: {limits[0]} conflicts with {limits[1]}"
    suggestion = None
    if value is not None and _is_allowed(setting, value):
        suggestion = setting, value
        text += f"; {setting} = {value:g} fits"
    found = ConflictError(text)
    found.limits, found.suggestion = limits, suggestion
    return found


def _is_allowed(setting: str, value: float) -> bool:
    try:
        section, key = setting.split(".")
        change_section(SurveyConfig(), section, **{key: value})
    except ConfigError:
        return False
    return True


def last_that_fits(
    fits: Callable[[float], bool], inside: float, outside: float, tolerance: float = 1e-4
) -> float:
    """The value nearest to `outside` that fits, by bisection.

    Args:
        fits: true from `inside` up to some value, false from there to `outside`.
        inside: a value that fits.
        outside: one that does not, above or below.
        tolerance: of the result.
    """
    while abs(outside - inside) > tolerance:
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if fits(middle) else (inside, middle)
    return inside
