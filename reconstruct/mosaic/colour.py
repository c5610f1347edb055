"""From what a picture shows to what the sea floor reflects: one model for the whole survey.

Light that reaches the camera is that of the sea floor, weakened, and that which the water throws
back (Akkaynak & Treibitz 2018, "A revised underwater image formation model"; the direct and the
backscattered light have separate coefficients):

    I = J exp(m(camera, place) + g(picture) - b (z - z0)) + A(camera, place)

with z the distance, per channel, in linear light. m, g and b follow from pairs of views of one spot
(`light`). A is the light of the darkest pixels that each place of the picture ever shows (dark
pixels, as in Akkaynak & Treibitz 2019, "Sea-thru"; a robust additive map of the survey, as in
Koeser et al. 2021), times a share per channel that the pairs themselves give: of two views of a
bright and of a dark spot a wrong A fits at most one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.base.artefacts import json_values
from alice_survey.base.frames import Array
from alice_survey.base.run import progress
from reconstruct.light.solve import (
    BRIGHT_PERCENT,
    GRID,
    SAMPLES_PER_FACT,
    LightModel,
    LightSamples,
    bilinear,
    brightening,
    neutral_factors,
    node_weights,
    solve_patterns,
)
from reconstruct.mosaic.finish import LEAST_LEFT, LEAST_RANGE, MOST_RANGE
from reconstruct.mosaic.picture_measures import PictureMeasures

Float32 = NDArray[np.float32]
Colour = Literal["even", "water", "raw"]

_FEWEST_PICTURES = 12
"""Fewest pictures of a camera for the darkest pixels of a place to be dark."""
_DARK_QUANTILE = 0.15
"""Quantile of the pictures' darkest light at a place, which a few black outliers do not move."""
_GAIN_SIGMA = 1.0
"""Expected size of the logarithm of a picture's own light: a stop and a half either way."""
_SHARES = np.linspace(0.0, 1.0, 6)
_MOST_SAMPLES = 20_000
"""Most samples that the share of the additive light is found from."""
_LARGEST_SIGMA = 0.25
"""Largest sigma of a share that is used."""
_LARGEST_WATER_SIGMA = 0.15
"""Largest sigma of the logarithm of the colour ratios lost to the water, for a correction by them.
"""
_LARGEST_LIFT = 30.0
_BRIGHT_LIGHT = 0.68
_MIDDLE_LIGHT = 0.22
_BLACK_QUANTILE = 0.01
"""Quantile of the darkest half percent of pixels around all places of all pictures."""
_BLACK_SHARE = 0.6
"""Share of that light that is taken as black: the rest keeps detail in shadows."""
_HIGHEST_BLACK = 0.05
_FEWEST_DARK = 50
"""Places, for the dark of a survey to be known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColourModel:
    """What turns the linear light of pictures into that of the sea floor."""

    light: LightModel
    added: Mapping[str, Array]
    """Per camera (rows, columns, 3): light that the water adds at the nodes, BGR."""
    shares: Array
    """(3,) share of the darkest pixels' light that is taken to be the water's; 0 where not known.
    """
    share_sigmas: Array
    """(3,) sigmas of the shares."""
    notes: tuple[str, ...]
    black: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) level of the corrected light that is shown as black; white stays white."""

    def nodes(self, camera: str, image: str) -> Float32:
        """(rows, columns, 6) factors, and light that is taken away before, at the nodes, BGR."""
        lift = np.exp(-(self.light.patterns[camera] + self.light.gains[image]))
        lift = np.clip(lift, 1.0 / _LARGEST_LIFT, _LARGEST_LIFT) * self.light.white
        both: Float32 = np.concatenate([lift, self.added[camera]], axis=2).astype(np.float32)
        return np.ascontiguousarray(both)

    @property
    def law(self) -> Float32:
        """(10,) fall-off and middle range, light that is black, factors: see `finish_colours`."""
        model = self.light
        values = [*model.fall_off, model.middle_range, *self.black, *(1.0 / (1.0 - self.black))]
        return np.array(values, np.float32)

    def corrected(
        self, light: Float32, camera: str, image: str, places: Float32, ranges: Float32
    ) -> Float32:
        """The sea floor's light, (H, W, 3) BGR, where black is not yet taken away.

        Args:
            light: (H, W, 3) that the picture shows.
            camera: that took it.
            image: its name.
            places: (H * W, 2) x and y over the picture's width and height.
            ranges: (H, W); NaN where not known.
        """
        model = self.light
        x, y = np.ascontiguousarray((places * np.array([GRID[1] - 1, GRID[0] - 1], np.float32)).T)
        found = bilinear(self.nodes(camera, image), x, y).reshape(*light.shape[:2], 6)
        left = np.maximum(light - found[..., 3:], LEAST_LEFT * light)
        result: Float32 = left * found[..., :3]
        if model.fall_off.any():
            beyond = np.nan_to_num(ranges - np.float32(model.middle_range))
            for channel in range(3):
                fall_off = np.float32(model.fall_off[channel])
                result[..., channel] *= np.clip(np.exp(fall_off * beyond), LEAST_RANGE, MOST_RANGE)
        return result

    def to_json(self) -> dict[str, Any]:
        """What was found, for `mosaic.json`."""
        values = {
            "white_blue_green_red": self.light.white,
            "fall_off_per_unit_blue_green_red": self.light.fall_off,
            "fall_off_sigma_blue_green_red": self.light.fall_off_sigma,
            "black_blue_green_red": self.black,
            "middle_range": float(self.light.middle_range),
            "added_light_share_blue_green_red": self.shares,
            "added_light_share_sigma_blue_green_red": self.share_sigmas,
        }
        found: dict[str, Any] = json_values(values)
        return found


@progress.step("even the light")
def solve_colour(
    wanted: Colour, samples: LightSamples, facts: Sequence[PictureMeasures]
) -> ColourModel:
    """Find the model from spots that two views see.

    Args:
        wanted: `raw`: pictures as they are; `even`: without m, g and b; `water`: without A too.
        samples: linear light; its logarithm and ranges.
        facts: of all pictures.
    """
    nothing = {fact.camera: np.zeros((*GRID, 3)) for fact in facts}
    model = ColourModel(
        light=LightModel(
            patterns=nothing, gains={fact.image: np.zeros(3) for fact in facts}, white=np.ones(3)
        ),
        added=nothing,
        shares=np.zeros(3),
        share_sigmas=np.full(3, np.nan),
        notes=("colours: as the pictures show them",),
    )
    if wanted == "raw":
        return model
    notes = []
    if wanted == "water":
        added, shares, sigmas, note = _added(samples, facts)
        model = replace(model, added=added, shares=shares, share_sigmas=sigmas)
        notes.append(note)
    cleaned = without(samples, model.added, facts)
    patterns = _patterns(cleaned, model.added, facts)
    model = replace(model, light=patterns)
    neutral = _unweakened(patterns) if wanted == "water" else None
    white = _white(cleaned, model, facts, neutral)
    if neutral is None:
        notes.append(
            "colours: light of lamp, lens and range evened out over the survey; one factor per "
            "colour for the whole survey makes what is bright in it neutral"
        )
        if wanted == "water":
            notes.append(
                "colours: ranges differ too little to find how much the water weakens each colour"
            )
    else:
        notes.append(
            "colours: light of lamp, lens and range evened out over the survey; each colour "
            "strengthened by what the water took over the middle range, as under a white lamp"
        )
    notes.append(
        "brightness: one factor puts the survey's median at most at 22 % and 98 % of it below "
        "68 % of white; sRGB"
    )
    model = replace(model, light=replace(patterns, white=white))
    black = _black(model, facts)
    if black.any():
        grow = _brighter(cleaned, model, facts, black)
        model = replace(model, light=replace(patterns, white=white * grow), black=black * grow)
        notes.append(
            f"contrast: light below {100 * _BLACK_SHARE:.0f} % of what the survey's darkest pixels "
            "show is black; one straight line from there to white"
        )
    return replace(model, notes=tuple(notes))


def _patterns(
    cleaned: LightSamples, added: Mapping[str, Array], facts: Sequence[PictureMeasures]
) -> LightModel:
    """The light of lamps, pictures and ranges, once that which the water adds is taken away."""
    nodes = np.exp(np.stack([fact.nodes for fact in facts]))
    left = nodes - np.stack([added[fact.camera] for fact in facts])
    with np.errstate(invalid="ignore"):
        usable = left > LEAST_LEFT * nodes
    return solve_patterns(
        cleaned,
        np.where(usable, np.log(np.where(usable, left, 1.0)), np.nan),
        [fact.image for fact in facts],
        [fact.camera for fact in facts],
        _GAIN_SIGMA,
    )


def _black(model: ColourModel, facts: Sequence[PictureMeasures]) -> Array:
    """(3,) corrected light that is shown as black: a share of what is dark in dark pictures."""
    dark = []
    for fact in facts:
        nodes = model.nodes(fact.camera, fact.image).astype(np.float64)
        dark.append(((fact.dark - nodes[..., 3:]) * nodes[..., :3]).reshape(-1, 3))
    levels = np.concatenate(dark)
    levels = levels[np.isfinite(levels).all(axis=1)]
    if len(levels) < _FEWEST_DARK:
        return np.zeros(3)
    black: Array = _BLACK_SHARE * np.maximum(np.quantile(levels, _BLACK_QUANTILE, axis=0), 0.0)
    return np.minimum(black, _HIGHEST_BLACK)


def _brighter(
    samples: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures], black: Array
) -> float:
    """The factor of light and black that puts bright and middle back where they were."""
    if not len(samples.views):
        return 1.0
    level = _levels(samples, model, facts) * model.light.white
    grey, dark = level.mean(axis=1), float(black.mean())
    bright, middle = np.percentile(grey, BRIGHT_PERCENT), np.median(grey)
    # factor f with (f level - f dark) / (1 - f dark) = wanted
    return float(
        min(
            wanted / max(found - dark + wanted * dark, 1e-6)
            for found, wanted in ((bright, _BRIGHT_LIGHT), (middle, _MIDDLE_LIGHT))
        )
    )


def _weakening(samples: LightSamples, light: LightModel, facts: Sequence[PictureMeasures]) -> Array:
    """(N, 2, 3) logarithm by which light weakens what both views show of the samples."""
    gains = np.stack([light.gains[fact.image] for fact in facts])
    factor = sampled(samples, light.patterns, facts) + gains[samples.views]
    if samples.ranges is not None:
        factor = factor - (samples.ranges - light.middle_range)[..., None] * light.fall_off
    return factor


def _levels(samples: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures]) -> Array:
    """(N, 3) light of the first views of samples, evened out, white not yet balanced."""
    return np.asarray(np.exp(samples.levels[:, 0] - _weakening(samples, model.light, facts)[:, 0]))


def without(
    samples: LightSamples, added: Mapping[str, Array], facts: Sequence[PictureMeasures]
) -> LightSamples:
    """Samples minus the light that the water adds; where too little is left they are dropped."""
    light = np.exp(samples.levels.astype(np.float64))
    left = light - sampled(samples, added, facts)
    kept = (left > LEAST_LEFT * light).all(axis=(1, 2))
    return replace(_part(samples, kept), levels=np.log(left[kept]).astype(np.float32))


def _part(samples: LightSamples, chosen: Any) -> LightSamples:
    """The chosen rows of samples."""
    return LightSamples(
        views=samples.views[chosen],
        places=samples.places[chosen],
        levels=samples.levels[chosen],
        ranges=None if samples.ranges is None else samples.ranges[chosen],
    )


def sampled(
    samples: LightSamples, maps: Mapping[str, Array], facts: Sequence[PictureMeasures]
) -> Array:
    """(N, 2, 3) values of maps over the pictures where both views see the spots."""
    names = sorted(maps)
    stacked = np.stack([maps[name].reshape(-1, 3) for name in names])
    camera_of = np.array([names.index(fact.camera) for fact in facts])
    values = np.empty((len(samples.views), 2, 3))
    for side in range(2):
        at, weights = node_weights(samples.places[:, side])
        found = stacked[camera_of[samples.views[:, side]][:, None], at]
        values[:, side] = (found * weights[..., None]).sum(axis=1)
    return values


def darkest(facts: Sequence[PictureMeasures]) -> dict[str, Array] | None:
    """Per camera (rows, columns, 3) light of the darkest that each place shows; None if too few."""
    maps = {}
    for name in sorted({fact.camera for fact in facts}):
        mine = np.stack([fact.dark for fact in facts if fact.camera == name])
        if (np.isfinite(mine).sum(axis=0) < _FEWEST_PICTURES).any():
            return None
        level = np.nanquantile(mine, _DARK_QUANTILE, axis=0).astype(np.float32)
        # light in water is smooth; a node may hold what was never dark there
        level = np.minimum(level, cv2.medianBlur(level, 3))
        maps[name] = cv2.GaussianBlur(level, (0, 0), 0.7).astype(np.float64)
    return maps


def _added(
    samples: LightSamples, facts: Sequence[PictureMeasures]
) -> tuple[Mapping[str, Array], Array, Array, str]:
    """The water's light, its share of the darkest pixels' per channel with sigma, and a note."""
    nothing = {fact.camera: np.zeros((*GRID, 3)) for fact in facts}
    unknown = np.full(3, np.nan)
    dark = darkest(facts)
    if dark is None:
        note = (
            f"colours: fewer than {_FEWEST_PICTURES} pictures of a camera show each place of it; "
            "no light of the water taken away"
        )
        return nothing, np.zeros(3), unknown, note
    thin = _part(samples, slice(None, None, max(1, -(-len(samples.views) // _MOST_SAMPLES))))
    cost = np.empty((len(_SHARES), 3))
    for n, share in enumerate(_SHARES):
        cost[n] = _misfit(thin, {name: share * level for name, level in dark.items()}, facts)
    shares, sigmas = np.zeros(3), unknown.copy()
    for channel in range(3):
        shares[channel], sigmas[channel] = _lowest(cost[:, channel])
    known = sigmas <= _LARGEST_SIGMA
    if not known.all():
        words = ", ".join(f"{s:.2f}" for s in sigmas)
        note = (
            f"colours: overlaps do not determine the water's light (sigma of its share {words} for "
            "blue, green, red); none taken away"
        )
        return nothing, np.zeros(3), sigmas, note
    note = (
        "colours: light that the water adds taken away: what the darkest pixels at each place of "
        "the pictures show, times a share per colour that overlaps determine"
    )
    return {name: shares * level for name, level in dark.items()}, shares, sigmas, note


def _misfit(
    samples: LightSamples, added: Mapping[str, Array], facts: Sequence[PictureMeasures]
) -> Array:
    """(3,) twice the negative logarithm of the likelihood of an additive light, robust.

    Of two views I1 = M1 J + A1 and I2 = M2 J + A2 the difference (I1 - A1) M2 - (I2 - A2) M1 holds
    only noise, whose size is that of I and does not shrink as A grows.
    """
    light = np.exp(samples.levels.astype(np.float64))
    left = light - sampled(samples, added, facts)
    model = _patterns(without(samples, added, facts), added, facts)
    factor = np.exp(_weakening(samples, model, facts))
    rest = left[:, 0] * factor[:, 1] - left[:, 1] * factor[:, 0]
    size = np.hypot(light[:, 0] * factor[:, 1], light[:, 1] * factor[:, 0])
    # for errors of Laplace's distribution, whose size the rest itself gives
    rest = np.abs(rest / size)
    mean = np.minimum(rest, 4.0 * np.median(rest, axis=0)).mean(axis=0) + 1e-9
    return np.asarray(2.0 * len(rest) / SAMPLES_PER_FACT * np.log(mean))


def _lowest(cost: Array) -> tuple[float, float]:
    """Where a parabola through the costs of `_SHARES` is lowest between 0 and 1, and its sigma."""
    best = int(np.clip(np.argmin(cost), 1, len(cost) - 2))
    step = _SHARES[1] - _SHARES[0]
    curve = (cost[best - 1] - 2.0 * cost[best] + cost[best + 1]) / step**2
    if not curve > 0:
        curve = max(curve, np.polyfit(_SHARES, cost, 2)[0] * 2.0)
    if not curve > 0:
        return 0.0, float("inf")
    slope = (cost[best + 1] - cost[best - 1]) / (2.0 * step)
    at = float(np.clip(_SHARES[best] - slope / curve, 0.0, 1.0))
    return at, float(np.sqrt(2.0 / curve))


def _unweakened(light: LightModel) -> Array | None:
    """(3,) factors, of mean 1, by which the water weakened colours over the middle range.

    Spreading weakens all colours alike, so that only their differences say something of the water.

    Returns:
        None where the differences are not known well enough.
    """
    sigma = np.hypot(light.fall_off_sigma[[0, 2]], light.fall_off_sigma[1]) * light.middle_range
    if not (light.middle_range > 0 and (sigma < _LARGEST_WATER_SIGMA).all()):
        return None
    factors = np.exp(light.fall_off * light.middle_range)
    unweakened: Array = factors / factors.mean()
    return unweakened


def _white(
    samples: LightSamples,
    model: ColourModel,
    facts: Sequence[PictureMeasures],
    neutral: Array | None,
) -> Array:
    """Factors that make what is bright neutral, and the survey light without burning out.

    With `neutral` given, colours are multiplied by that instead of being made neutral.
    """
    if not len(samples.views):
        return np.ones(3)
    level = _levels(samples, model, facts)
    if neutral is None:
        neutral = neutral_factors(level)
    return neutral * brightening(level * neutral, _BRIGHT_LIGHT, _MIDDLE_LIGHT)
