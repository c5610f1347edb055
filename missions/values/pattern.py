"""What the lines of a survey must give: how far apart, how long, what each surely sees."""

import math
from dataclasses import dataclass

from missions.values.footprint import Swath

_WHOLE = 1e-9


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """Spacing of lines and pictures, and how far they reach over the area's edge.

    In an endless pattern every point is seen by at least `passes` lines, and by at least `pictures`
    pictures of each of these. So that the edge sees no less, the outermost lines lie `edge_m`
    outside of it, and lines begin and end `overhang_m` outside of it; both may be negative, then
    they lie inside. They never leave more than half a spacing (half a step) without its own line
    (picture).
    """

    spacing_m: float
    """Distance between neighbouring lines, the same everywhere."""
    step_m: float
    """Distance from picture to picture on a line."""
    half_across_m: float
    """What every camera surely sees to either side of a line."""
    half_along_m: float
    """What every camera surely sees ahead and astern of a picture."""

    @property
    def passes(self) -> int:
        """Least number of lines that see a point of an endless pattern."""
        return max(1, math.floor(2 * self.half_across_m / self.spacing_m + _WHOLE))

    @property
    def pictures(self) -> int:
        """Least number of pictures of one line that see a point below it."""
        return max(1, math.floor(2 * self.half_along_m / self.step_m + _WHOLE))

    @property
    def min_steps(self) -> int:
        """Least number of steps of a line, from picture to picture."""
        return max(1, self.pictures - 1)

    @property
    def edge_m(self) -> float:
        """How far outside of the area the outermost lines lie at least."""
        return _outside(self.spacing_m, self.half_across_m, self.passes)

    @property
    def overhang_m(self) -> float:
        """How far outside of the area a line begins and ends at least."""
        return _outside(self.step_m, self.half_along_m, self.pictures)


def pattern(stereo: Swath, spacing_m: float, step_m: float) -> Pattern:
    """The pattern of a vehicle with a swath; headings alternate, so the worse side counts."""
    return Pattern(
        spacing_m=spacing_m,
        step_m=step_m,
        half_across_m=stereo.half_across_m,
        half_along_m=min(stereo.astern_m, stereo.ahead_m),
    )


def _outside(step_m: float, half_m: float, times: int) -> float:
    """The least place outside of an edge that sees it often enough.

    The edge is seen `times` times and is no farther than half a step from the place.
    """
    return max(-step_m / 2, (times - 1) * step_m - half_m)
