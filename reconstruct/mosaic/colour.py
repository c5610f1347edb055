"""From what a picture shows to what the sea floor reflects: one model for the whole survey.

Light that reaches the camera is that of the sea floor, weakened, and that which the water throws
back (Akkaynak & Treibitz 2018, "A revised underwater image formation model"; the direct and the
backscattered light have separate coefficients):

    I = J exp(m(camera, place) + g(picture) - b (z - z0)) (z0 / z)^s + A(camera, place, z)

with z the distance, per channel, in linear light. All follow from pairs of views of one spot:
b and A by `light.water`, then m and g by `light.solve`. White is that of a reference in a picture
where there is one. Otherwise it is between two guesses that each are off by as much: a lamp and a
camera that are white together, whose light the water weakened by exp(-b z0), and a sea floor whose
bright spots are grey.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import json_values
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.light.solve import (
    BRIGHT_PERCENT,
    GRID,
    LightModel,
    LightSamples,
    bilinear,
    brightening,
    in_one_part,
    neutral_factors,
    node_weights,
    solve_patterns,
)
from reconstruct.light.water import GREEN, MIN_LEFT, WaterLight, growth_at, solve_water
from reconstruct.mosaic.picture_measures import PictureMeasures, ReferencePatch, encode_srgb

Float32 = NDArray[np.float32]

MIN_RANGE, MAX_RANGE = np.float32(0.2), np.float32(5.0)
"""Factors by which light is changed at least and at most for its distance."""
_BRIGHTEST = np.float32(4.0)
"""Light beyond which it looks the same."""

Colour = Literal["even", "water", "raw"]

_MIN_PICTURES = 12
"""Fewest pictures of a camera for the darkest pixels of a place to be dark."""
_DARK_QUANTILE = 0.15
"""Quantile of the pictures' darkest light at a place, which a few black outliers do not move."""
_GAIN_SIGMA = 1.0
"""Expected size of the logarithm of a picture's own light: a stop and a half either way."""
_MAX_SAMPLES = 20_000
"""Most samples that the light of the water is found from."""
_WHITE_SIGMA = 0.2
"""Sigma of the logarithm of a colour's ratio to green, of lamp and camera, and of the sea floor."""
_NEAREST = 8
"""Samples next to a patch that give its range."""
_MAX_LIFT = 30.0
_BRIGHT_LIGHT = 0.68
_MIDDLE_LIGHT = 0.22
_BLACK_QUANTILE = 0.01
"""Quantile of the darkest half percent of pixels around all places of all pictures."""
_BLACK_SHARE = 0.6
"""Share of that light that is taken as black: the rest keeps detail in shadows."""
_HIGHEST_BLACK = 0.05
_MIN_DARK = 50
"""Places, for the dark of a survey to be known."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ColourModel:
    """What turns the linear light of pictures into that of the sea floor."""

    light: LightModel
    water: WaterLight | None
    """Light that the water adds; None where none is taken away."""
    notes: tuple[str, ...]
    black: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) level of the corrected light that is shown as black; white stays white."""

    def nodes(self, camera: str, image: str) -> Float32:
        """(rows, columns, 6) factors, and light that is taken away before, at the nodes, BGR."""
        lift = np.exp(-(self.light.patterns[camera] + self.light.gains[image]))
        lift = np.clip(lift, 1.0 / _MAX_LIFT, _MAX_LIFT) * self.light.white
        added = np.zeros_like(lift) if self.water is None else self.water.added[camera]
        both: Float32 = np.concatenate([lift, added], axis=2).astype(np.float32)
        return np.ascontiguousarray(both)

    @property
    def growth(self) -> Array:
        """(3,) coefficient with which the light that the water adds grows; 0 where it does not."""
        return np.zeros(3) if self.water is None else self.water.growth

    @property
    def spread(self) -> float:
        """Power of range by which light spreads, apart from the fall-off."""
        return 0.0 if self.water is None else self.water.spread

    def weakening(self, ranges: NDArray[np.floating[Any]]) -> Array:
        """(..., 3) logarithm of the light at ranges (...) over that at the middle range."""
        model = self.light
        found = -(np.asarray(ranges)[..., None] - model.middle_range) * model.fall_off
        if self.spread:
            found = found - self.spread * np.log(ranges / model.middle_range)[..., None]
        return np.asarray(found)

    def correct(
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
        ranges = np.where(np.isfinite(ranges), ranges, np.float32(model.middle_range))
        added = found[..., 3:]
        if self.growth.any():
            added = added * growth_at(self.growth, ranges, model.middle_range).astype(np.float32)
        result: Float32 = np.maximum(light - added, MIN_LEFT * light) * found[..., :3]
        if model.fall_off.any():
            back = np.exp(-self.weakening(ranges)).astype(np.float32)
            result *= np.clip(back, MIN_RANGE, MAX_RANGE)
        return result

    def levels(self, light: Float32) -> Float32:
        """Levels of the mosaic, 0 to 255 where corrected light is from black to white."""
        black = self.black.astype(np.float32)
        return encode_srgb(np.minimum((light - black) / (np.float32(1) - black), _BRIGHTEST))

    def to_json(self) -> dict[str, Any]:
        """What was found, for `mosaic.json`."""
        values = {
            "fall_off_per_unit_blue_green_red": self.light.fall_off,
            "fall_off_sigma_blue_green_red": self.light.fall_off_sigma,
            "middle_range": float(self.light.middle_range),
        }
        if self.water is not None:
            values |= {
                "added_light_share_blue_green_red": self.water.share,
                "added_light_share_sigma_blue_green_red": self.water.share_sigma,
                "spread": self.water.spread,
            }
        found: dict[str, Any] = json_values(values)
        return found


@progress.step("even the light")
def solve_colour(
    requested: Colour,
    samples: LightSamples,
    facts: Sequence[PictureMeasures],
    references: Sequence[ReferencePatch] = (),
) -> ColourModel:
    """Find the model from spots that two views see.

    Args:
        requested: `raw`: pictures as they are; `even`: without m, g and b; `water`: without A too.
        samples: linear light; its logarithm and ranges.
        facts: of all pictures.
        references: patches of known reflectance; where there are any, light is reflectance.
    """
    nothing = {fact.camera: np.zeros((*GRID, 3)) for fact in facts}
    gains = {fact.image: np.zeros(3) for fact in facts}
    model = ColourModel(
        light=LightModel(patterns=nothing, gains=gains, white=np.ones(3)),
        water=None,
        notes=("colours: as the pictures show them",),
    )
    if requested == "raw":
        return model
    notes = ["colours: light of lamp, lens and range evened out over the survey"]
    if requested == "water" and samples.ranges is not None and len(samples.views):
        water, note = _water(samples, facts)
        model = replace(
            model,
            water=water,
            light=replace(
                model.light,
                fall_off=water.fall_off,
                fall_off_sigma=water.fall_off_sigma,
                middle_range=water.middle_range,
            ),
        )
        notes.append(note)
    cleaned = _without_water(samples, model, facts)
    model = replace(model, light=_patterns(cleaned, model, facts))
    if found := _reference_white(samples, model, facts, references):
        white, note = found
        light = replace(model.light, white=white)
        return replace(model, light=light, notes=(*notes, note))
    white, note = _white(cleaned, model, facts)
    notes.append(note)
    notes.append("brightness: one factor for the whole survey; sRGB")
    model = replace(model, light=replace(model.light, white=white))
    cleared = model.water is not None and model.water.share.any()
    black = np.zeros(3) if cleared else _black(model, facts)
    if black.any():
        grow = _brighter(cleaned, model, facts, black)
        light = replace(model.light, white=white * grow)
        model = replace(model, light=light, black=black * grow)
        notes.append("contrast: part of what the survey's darkest pixels show is black")
    return replace(model, notes=tuple(notes))


def _water(samples: LightSamples, facts: Sequence[PictureMeasures]) -> tuple[WaterLight, str]:
    """What the water adds and takes, and a note."""
    dark = darkest(facts)
    unknown = dark is None
    if dark is None:
        dark = {fact.camera: np.zeros((*GRID, 3)) for fact in facts}
    cameras = [fact.camera for fact in facts]
    water = solve_water(samples.thin(_MAX_SAMPLES), dark, cameras)
    if water.share.any():
        return water, "colours: light that the water adds taken away, as overlaps determine it"
    sigmas = ", ".join(f"{s:.2f}" for s in water.share_sigma)
    few = f"fewer than {_MIN_PICTURES} pictures of a camera show each place of it"
    why = few if unknown else f"overlaps do not determine it (sigma of its share {sigmas}, BGR)"
    return water, f"colours: no light of the water taken away: {why}"


def _patterns(
    cleaned: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures]
) -> LightModel:
    """The light of lamps and pictures, once that which the water adds is taken away.

    The fall-off with range too, unless it is known.
    """
    nodes = np.exp(np.stack([fact.nodes for fact in facts]))
    water, known = model.water, model.light
    added = np.zeros_like(nodes)
    if water is not None:
        ranges = _node_ranges(cleaned, len(facts))
        added = np.stack([water.added[fact.camera] for fact in facts])
        added = added * growth_at(water.growth, ranges, water.middle_range)
        weaker = np.exp(model.weakening(ranges))
        nodes, added = nodes / weaker, added / weaker
        levels = cleaned.levels - model.weakening(np.asarray(cleaned.ranges))
        cleaned = replace(cleaned, levels=levels.astype(np.float32), ranges=None)
    left = nodes - added
    with np.errstate(invalid="ignore"):
        usable = left > MIN_LEFT * nodes
    found = solve_patterns(
        in_one_part(cleaned),
        np.where(usable, np.log(np.where(usable, left, 1.0)), np.nan),
        [fact.image for fact in facts],
        [fact.camera for fact in facts],
        _GAIN_SIGMA,
    )
    if water is None:
        return found
    return replace(known, patterns=found.patterns, gains=found.gains)


def _node_ranges(samples: LightSamples, pictures: int) -> Array:
    """(pictures, rows, columns) mean range around nodes; NaN where no sample is next to one."""
    size = GRID[0] * GRID[1]
    at, share = node_weights(samples.places.reshape(-1, 2))
    at = (at + size * samples.views.reshape(-1, 1).astype(np.int64)).ravel()
    ranges = np.asarray(samples.ranges, np.float64).reshape(-1, 1)
    weight = np.bincount(at, share.ravel(), pictures * size)
    total = np.bincount(at, (share * ranges).ravel(), pictures * size)
    with np.errstate(invalid="ignore"):
        found: Array = total / weight
    return found.reshape(pictures, *GRID)


def _black(model: ColourModel, facts: Sequence[PictureMeasures]) -> Array:
    """(3,) corrected light that is shown as black: a share of what is dark in dark pictures."""
    dark = []
    for fact in facts:
        nodes = model.nodes(fact.camera, fact.image).astype(np.float64)
        dark.append(((fact.dark - nodes[..., 3:]) * nodes[..., :3]).reshape(-1, 3))
    levels = np.concatenate(dark)
    levels = levels[np.isfinite(levels).all(axis=1)]
    if len(levels) < _MIN_DARK:
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
            requested / max(found - dark + requested * dark, 1e-6)
            for found, requested in ((bright, _BRIGHT_LIGHT), (middle, _MIDDLE_LIGHT))
        )
    )


def _levels(samples: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures]) -> Array:
    """(N, 3) light of the first views of samples, evened out, white not yet balanced."""
    gains = np.stack([model.light.gains[fact.image] for fact in facts])
    factor = sample_maps(samples, model.light.patterns, facts)[:, 0] + gains[samples.views[:, 0]]
    if samples.ranges is not None:
        factor = factor + model.weakening(samples.ranges[:, 0])
    return np.asarray(np.exp(samples.levels[:, 0] - factor))


def _without_water(
    samples: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures]
) -> LightSamples:
    """Samples minus the light that the water adds, and how much less sure they are for it.

    The usual error counts over the share of light that is left, and the loss between two ranges is
    off by as much of itself. Where too little is left they are dropped.
    """
    if model.water is None:
        return samples
    light = np.exp(samples.levels.astype(np.float64))
    beyond = growth_at(model.growth, np.asarray(samples.ranges), model.light.middle_range)
    left = light - sample_maps(samples, model.water.added, facts) * beyond
    kept = (left > MIN_LEFT * light).all(axis=(1, 2))
    loss = np.diff(model.weakening(np.asarray(samples.ranges)[kept]), axis=1)[:, 0]
    unsure = np.hypot((light[kept] / left[kept]).mean(axis=1), loss)
    levels = np.log(left[kept]).astype(np.float32)
    return replace(samples.part(kept), levels=levels, unsure=unsure)


def sample_maps(
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
        if (np.isfinite(mine).sum(axis=0) < _MIN_PICTURES).any():
            return None
        level = np.nanquantile(mine, _DARK_QUANTILE, axis=0).astype(np.float32)
        # light in water is smooth; a node may hold what was never dark there
        level = np.minimum(level, cv2.medianBlur(level, 3))
        maps[name] = cv2.GaussianBlur(level, (0, 0), 0.7).astype(np.float64)
    return maps


def _reference_white(
    samples: LightSamples,
    model: ColourModel,
    facts: Sequence[PictureMeasures],
    references: Sequence[ReferencePatch],
) -> tuple[Array, str] | None:
    """Factors that make light the reflectance of patches, and a note; None where none is seen."""
    cameras = {fact.image: fact.camera for fact in facts}
    numbers = {fact.image: number for number, fact in enumerate(facts)}
    ratios = []
    for patch in references:
        near = _range_near(samples, numbers[patch.image], patch.place)
        if near is None:
            continue
        shown = model.correct(
            patch.light[None, None].astype(np.float32), cameras[patch.image], patch.image,
            patch.place[None], np.full((1, 1), near, np.float32),
        )  # fmt: skip
        ratios.append(np.log(patch.reflectance / shown[0, 0]))
    if not ratios:
        return None
    apart = np.exp(np.std(ratios, axis=0).max()) - 1.0
    note = (
        f"colours: levels are reflectances (1 is white; sRGB) as {len(ratios)} patches of known "
        f"reflectance have them, which differ by {100 * apart:.1f} % rms"
    )
    return np.exp(np.mean(ratios, axis=0)), note


def _range_near(samples: LightSamples, view: int, place: NDArray[np.float32]) -> float | None:
    """The range at a place of a view: the median of the samples next to it."""
    which, side = np.nonzero(samples.views == view)
    if not len(which):
        return None
    if samples.ranges is None:
        return float("nan")
    away = np.hypot(*(samples.places[which, side] - place).T)
    next_to = np.argsort(away)[:_NEAREST]
    return float(np.median(samples.ranges[which, side][next_to]))


def _white(
    samples: LightSamples, model: ColourModel, facts: Sequence[PictureMeasures]
) -> tuple[Array, str]:
    """Factors that balance colours and light the survey without burning out, and a note."""
    if not len(samples.views):
        return np.ones(3), "colours: no overlaps; not balanced"
    level = _levels(samples, model, facts)
    neutral = neutral_factors(level)
    note = "colours: one factor per colour for the whole survey makes what is bright in it neutral"
    water = model.water
    if water is not None:
        taken = (water.fall_off - water.fall_off[GREEN]) * water.middle_range
        own = _WHITE_SIGMA**-2
        weight = 1.0 / (_WHITE_SIGMA**2 + (water.to_green_sigma * water.middle_range) ** 2)
        grey = np.log(neutral / neutral[GREEN])
        neutral = np.exp((weight * taken + own * grey) / (weight + own))
        neutral = neutral / neutral.mean()
        note = "colours: white is between a white lamp through this water and a grey sea floor"
    return neutral * brightening(level * neutral, _BRIGHT_LIGHT, _MIDDLE_LIGHT), note
