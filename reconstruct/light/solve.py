"""Light of lamps and lens taken out of the colours, as far as overlapping pictures determine it.

A lamp that travels with the camera leaves the same pattern in every picture: the model is
`log I = log J + m(camera, place in the picture) + g(picture)`, with J what the sea floor itself
shows. Two pictures that see one spot share J, so that their difference gives m and g without any
assumption about the scene (the multiplicative part of Koeser et al. 2021, "Robustly removing deep
sea lighting effects for visual mapping of abyssal plains"). What overlaps leave open, such as the
fall-off across a single line, is taken from the median of all pictures, in which the scene averages
out; it weighs the more, the more pictures there are. Along a line a lamp brighter ahead looks like
pictures that grow darker one by one: there the pictures' brightness counts, which the sea floor
changes at random and a drift would not. Where there are overlaps they outweigh both.

In the normal equations a sample touches the four nodes around each of its two places, two pictures
and the range, so that its share is a few numbers. Pictures, of which there may be thousands, are
eliminated first (their block is sparse: a picture meets its neighbours alone), which leaves a small
dense system for the patterns and the fall-off: the Schur complement, as in bundle adjustment.

Samples that are too large for memory are worked on part by part.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from alice_survey.core.artefacts import read_json, write_json
from alice_survey.core.block_solver import solve_symmetric
from alice_survey.core.compiled import compiled
from alice_survey.core.contents import taken_from
from alice_survey.core.executor import SERIAL, Executor
from alice_survey.core.frames import Array
from alice_survey.core.run import progress

GRID = (9, 11)
"""Rows and columns of nodes over a picture, first and last on its edges."""
LOW_WIDTH_PX = 108
"""Width to which pictures are shrunk before their light is compared."""
_DARKEST, _BRIGHTEST = 3.0, 250.0
"""Grey levels beyond which a pixel does not show the light."""
_MISFIT = 0.1
"""Difference of logarithms above which two views of a spot count less (shadow, gloss, mismatch)."""
_NODE_SIGMA, _BEND_SIGMA, _GAIN_SIGMA = 2.0, 0.05, 0.3
"""Expected size of m at a node, of its second difference, and of g; logarithms."""
SAMPLES_PER_FACT = 20.0
"""Samples of one pair of pictures that together count as much as one independent one."""
_ROUNDS = 6
FALL_OFF_SIGMA = 4.0
"""Expected logarithm of the light lost over the middle range."""
_SCENE_SIGMA = 0.5
"""Spread of the sea floor's own logarithmic brightness from picture to picture."""
_MIN_PICTURES = 6
"""Fewest pictures of a camera whose median counts."""
_MIN_SHOWN = 0.5
"""Share of a picture's nodes that must be seen for its brightness to be known."""
_MAX_GAIN = 8.0
BRIGHT_PERCENT = 98.0
"""Share of a survey's spots that are no brighter than what counts as bright."""
_WHITE_LEVEL, _GREY_LEVEL = 215.0, 128.0
_WHITE_PARTS = 4
"""White is found from as many samples as this many parts have."""
_NORM = 6.0


Item = TypeVar("Item")
Loaded = TypeVar("Loaded")
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, eq=False)
class Parts(Generic[Item, Loaded]):
    """Parts that are loaded where they are worked on; a single one is loaded once, and here."""

    items: Sequence[Item]
    """From which parts are loaded, such as the paths of files; at least one."""
    load: Callable[[Item], Loaded]
    """A task."""
    label: str
    """What is done, for the progress bar."""
    executor: Executor = SERIAL
    _kept: list[Loaded] = field(default_factory=list, init=False)

    @property
    def is_one(self) -> bool:
        """Whether they are one part."""
        return len(self.items) == 1

    def map(
        self, function: Callable[[Loaded, Any], Result], values: Iterable[Any] | None = None
    ) -> Iterator[Result]:
        """Yield `function(part, value)` of every part, in order.

        Args:
            function: a task of a part and its value.
            values: one for each part; None where tasks need none.
        """
        values = repeat(None, len(self.items)) if values is None else values
        if self.is_one:
            if not self._kept:
                self._kept.append(self.load(self.items[0]))
            return (function(self._kept[0], value) for value in values)
        tasks = zip(self.items, values, strict=True)
        run = partial(_run, self.load, function)
        return self.executor.map(run, tasks, label=self.label, total=len(self.items))


def _run(
    load: Callable[[Item], Loaded],
    function: Callable[[Loaded, Any], Result],
    task: tuple[Item, Any],
) -> Result:
    item, value = task
    return function(load(item), value)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightSamples:
    """Spots that two pictures see; arrays of N rows."""

    views: NDArray[np.int32]
    """(N, 2) numbers of the two views."""
    places: NDArray[np.float32]
    """(N, 2, 2) where each sees the spot: x and y over the picture's width and height."""
    levels: NDArray[np.float32]
    """(N, 2, 3) logarithm of the low-passed BGR levels."""
    ranges: NDArray[np.float32] | None = None
    """(N, 2) distances at which the views see the spots; None where they do not count."""
    unsure: Array | None = None
    """(N, 3) factors of their errors over the usual; None for 1."""

    def part(self, chosen: Any) -> "LightSamples":
        """The chosen rows, copied: a view of a few would keep all in memory."""
        known = {name: values for name, values in vars(self).items() if values is not None}
        return LightSamples(**{name: np.array(values[chosen]) for name, values in known.items()})

    def thin(self, maximum: int) -> "LightSamples":
        """Every so many-th row, as many as a number or fewer."""
        return self.part(slice(None, None, max(1, -(-len(self.views) // maximum))))


@dataclass(frozen=True, kw_only=True, eq=False)
class LightModel:
    """What to divide colours by."""

    patterns: Mapping[str, Array]
    """Per camera (rows, columns, 3): logarithm of the light at the nodes, BGR."""
    gains: Mapping[str, Array]
    """Per picture (3,): logarithm of its light, BGR."""
    white: Array
    """(3,) factors, the same for all pictures, that take the cast of water and light away."""
    fall_off: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) decrease of the logarithm of light for each unit of range."""
    fall_off_sigma: Array = field(default_factory=lambda: np.full(3, np.inf))
    """(3,) sigma of it."""
    middle_range: float = 0.0
    """Range at which patterns and gains hold."""

    def factors(self, camera: str, image: str) -> NDArray[np.float32]:
        """(rows, columns, 3) factors at the nodes that take a picture's BGR to even light."""
        log_light = self.patterns[camera] + self.gains[image]
        lift = np.clip(np.exp(-log_light), 1.0 / _MAX_GAIN, _MAX_GAIN)
        return (lift * self.white).astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class LightEquations:
    """Samples as equations: matrix @ (nodes, fall-off, gains) = target, N rows.

    Gains are those of a part's own views.
    """

    matrix: csr_array
    """(N, P + 1 + v), eleven entries a row."""
    target: Array
    """(N, 3) differences of logarithms."""
    misfit: Array
    """(N, 3) where an error becomes large; also the expected size of one."""


LinearParts = Parts[Any, LightEquations]
"""Equations of all samples, in the same parts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPrior:
    """What is known before the pictures."""

    patterns: Array
    """(P + 1, P + 1) normal matrix of nodes and fall-off."""
    right: Array
    """(P + 1,) right side of the normal equations."""
    gain: Array
    """(V,) inverse variance of each picture's gain."""
    gain_right: Array
    """(V,) inverse variance times the gain expected."""


def low_pass(colour: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """A small blurred copy (h, w, 3) of what is valid, in which views can be compared.

    Args:
        colour: (H, W, 3).
        valid: (H, W); what is not is left out of all averages (0 where nothing is near).
    """
    size = (LOW_WIDTH_PX, max(8, round(LOW_WIDTH_PX * valid.shape[0] / valid.shape[1])))
    return blur_valid(colour.astype(np.float32), valid.astype(np.float32), size)


def blur_valid(
    picture: NDArray[np.float32], weight: NDArray[np.float32], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Weighted means of a picture (H, W, 3) around the pixels of a smaller one (w, h)."""
    total, share = (
        cv2.GaussianBlur(cv2.resize(part, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0)
        for part in (picture * weight[..., None], weight)
    )
    return np.asarray(total / np.maximum(share, np.float32(1e-3))[..., None])


def at_places(
    picture: NDArray[np.float32], places: NDArray[np.float32], channels: int = 3
) -> NDArray[np.float32]:
    """Bilinear values (N, channels) of a picture at places (N, 2) over its width and height."""
    height, width = picture.shape[:2]
    x = places[:, 0] * np.float32(width) - np.float32(0.5)
    y = places[:, 1] * np.float32(height) - np.float32(0.5)
    picture = np.ascontiguousarray(picture, np.float32).reshape(height, width, channels)
    return bilinear(picture, x.astype(np.float32), y.astype(np.float32))


@compiled
def bilinear(
    picture: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Values (N, channels) of a picture (H, W, channels) at columns and rows, edges repeated.

    `cv2.remap` rounds places to 1/32 of a pixel, which shows as steps in smooth light.
    """
    height, width, channels = picture.shape
    found = np.empty((len(x), channels), np.float32)
    for n in range(len(x)):
        u = min(max(x[n], np.float32(0.0)), np.float32(width - 1))
        v = min(max(y[n], np.float32(0.0)), np.float32(height - 1))
        left, top = min(int(u), width - 2), min(int(v), height - 2)
        p, q = u - np.float32(left), v - np.float32(top)
        for c in range(channels):
            above = picture[top, left, c] * (1 - p) + picture[top, left + 1, c] * p
            below = picture[top + 1, left, c] * (1 - p) + picture[top + 1, left + 1, c] * p
            found[n, c] = above * (1 - q) + below * q
    return found


def compare_light(
    views: tuple[int, int],
    pictures: tuple[NDArray[np.float32], NDArray[np.float32]],
    places: tuple[NDArray[np.float32], NDArray[np.float32]],
) -> LightSamples:
    """What two views of the same spots show.

    Args:
        views: their numbers.
        pictures: low-passed, BGR.
        places: (N, 2) each, where they see the spots.
    """
    first, second = (at_places(p, at) for p, at in zip(pictures, places, strict=True))
    levels = np.stack([first, second], axis=1)
    usable = ((levels > _DARKEST) & (levels < _BRIGHTEST)).all(axis=(1, 2))
    return LightSamples(
        views=np.broadcast_to(np.array(views, np.int32), (int(usable.sum()), 2)).copy(),
        places=np.stack(places, axis=1)[usable],
        levels=np.log(levels[usable]),
    )


_STORED = np.dtype([("views", "i4", 2), ("places", "f4", (2, 2)), ("levels", "f4", (2, 3))])


def as_rows(samples: LightSamples) -> NDArray[np.void]:
    """Samples without ranges as one array (N,) to keep in a file."""
    rows = np.empty(len(samples.views), _STORED)
    rows["views"], rows["places"], rows["levels"] = samples.views, samples.places, samples.levels
    return rows


def from_rows(rows: NDArray[np.void]) -> LightSamples:
    """The samples that `as_rows` kept."""
    return LightSamples(views=rows["views"], places=rows["places"], levels=rows["levels"])


def joined_samples(parts: Sequence[LightSamples]) -> LightSamples:
    """Samples of several pairs as one; their ranges count when all parts have some."""
    ranges = [p.ranges for p in parts if p.ranges is not None]
    return LightSamples(
        ranges=np.concatenate(ranges) if ranges and len(ranges) == len(parts) else None,
        views=np.concatenate([np.empty((0, 2), np.int32), *(p.views for p in parts)]),
        places=np.concatenate([np.empty((0, 2, 2), np.float32), *(p.places for p in parts)]),
        levels=np.concatenate([np.empty((0, 2, 3), np.float32), *(p.levels for p in parts)]),
    )


SampleParts = Parts[Any, LightSamples]
"""Samples of a survey, in parts that fit in memory."""


def in_one_part(samples: LightSamples) -> SampleParts:
    """Samples that are in memory."""
    return Parts(items=[()], load=lambda _: samples, label="light of all pictures")


@progress.step("solve the light of all pictures")
def solve_light(
    parts: SampleParts, nodes: Array, images: Sequence[str], cameras: Sequence[str]
) -> LightModel:
    """Find patterns and gains by robust least squares over all pairs of views.

    Args:
        parts: spots seen by two views, without ranges.
        nodes: (V, rows, columns, 3) logarithm of what each view shows at the nodes, BGR; NaN where
            it shows nothing.
        images: names of the views, by number.
        cameras: their cameras.
    """
    even = solve_patterns(parts, nodes, images, cameras)
    return replace(even, white=_white(parts, even, images, cameras))


def solve_patterns(
    parts: SampleParts,
    nodes: Array,
    images: Sequence[str],
    cameras: Sequence[str],
    gain_sigma: float = _GAIN_SIGMA,
) -> LightModel:
    """As `solve_light`, with a white of 1; of one part with ranges the fall-off with them too.

    Args:
        parts: see `solve_light`.
        nodes: see `solve_light`.
        images: see `solve_light`.
        cameras: see `solve_light`.
        gain_sigma: expected size of the logarithm of a picture's own light.
    """
    middle = next(parts.map(_middle_range)) if parts.is_one else 0.0
    names = sorted(set(cameras))
    number = {name: n for n, name in enumerate(names)}
    camera_of = np.array([number[camera] for camera in cameras])
    bends = _prior(len(names), FALL_OFF_SIGMA / middle if middle > 0 else 1.0)
    pull, pulled = _typical(nodes, camera_of, len(names))
    brightness, known_gain = _brightness(nodes, camera_of, len(names))
    priors = [
        LightPrior(
            patterns=bends + np.diag(pull[:, channel]),
            right=pulled[:, channel],
            gain=gain_sigma**-2 + known_gain / _SCENE_SIGMA**2,
            gain_right=brightness[:, channel] / _SCENE_SIGMA**2,
        )
        for channel in range(3)
    ]
    views = [np.arange(len(cameras))] if parts.is_one else list(parts.map(_views_of))
    linear: LinearParts = Parts(
        items=[(item, own, camera_of[own]) for item, own in zip(parts.items, views, strict=True)],
        load=partial(_linear, parts.load, len(names)), label=parts.label, executor=parts.executor,
    )  # fmt: skip
    solution, gains, variance = solve_robustly(linear, views, priors)
    patterns = solution[:-1].reshape(len(names), *GRID, 3)
    patterns = patterns - patterns.mean(axis=(0, 1, 2))
    gains = gains - gains.mean(axis=0)
    return LightModel(
        patterns=dict(zip(names, patterns, strict=True)),
        gains=dict(zip(images, gains, strict=True)),
        white=np.ones(3),
        fall_off=solution[-1],
        fall_off_sigma=np.sqrt(variance),
        middle_range=middle,
    )


def _middle_range(samples: LightSamples, _: None) -> float:
    if samples.ranges is None or not len(samples.views):
        return 0.0
    return float(np.median(samples.ranges))


def _views_of(samples: LightSamples, _: None) -> NDArray[np.int64]:
    return np.unique(samples.views).astype(np.int64)


def _linear(
    load: Callable[[Any], LightSamples],
    cameras: int,
    part: tuple[Any, NDArray[np.int64], NDArray[np.int64]],
) -> LightEquations:
    """The equations of a part, which count in its own views (v,) of cameras (v,)."""
    item, own, camera_of = part
    samples = load(item)
    size, count = GRID[0] * GRID[1], len(samples.views)
    views = np.searchsorted(own, samples.views)
    columns, values = np.empty((count, 11), np.int64), np.empty((count, 11))
    for side, sign in enumerate((1.0, -1.0)):
        nodes, weights = node_weights(samples.places[:, side])
        at = slice(4 * side, 4 * side + 4)
        columns[:, at] = nodes + size * camera_of[views[:, side]][:, None]
        values[:, at] = sign * weights
    unknowns = cameras * size + 1
    columns[:, 8], columns[:, 9:] = unknowns - 1, unknowns + views
    values[:, 8:] = 0.0, 1.0, -1.0
    if samples.ranges is not None:
        values[:, 8] = samples.ranges[:, 1].astype(np.float64) - samples.ranges[:, 0]
    rows = np.arange(0, 11 * count + 1, 11)
    levels = samples.levels.astype(np.float64)
    unsure = 1.0 if samples.unsure is None else samples.unsure
    return LightEquations(
        matrix=csr_array(
            (values.ravel(), columns.ravel(), rows), shape=(count, unknowns + len(own))
        ),
        target=levels[:, 0] - levels[:, 1],
        misfit=np.full((count, 3), _MISFIT) * unsure,
    )


def node_weights(places: NDArray[np.float32]) -> tuple[NDArray[np.int64], Array]:
    """The four nodes around each place and their bilinear weights, (N, 4) each."""
    rows, columns = GRID
    x = np.clip(places[:, 0].astype(np.float64), 0, 1) * (columns - 1)
    y = np.clip(places[:, 1].astype(np.float64), 0, 1) * (rows - 1)
    left = np.minimum(x.astype(np.int64), columns - 2)
    top = np.minimum(y.astype(np.int64), rows - 2)
    a, b = x - left, y - top
    corner = top * columns + left
    nodes = np.stack([corner, corner + 1, corner + columns, corner + columns + 1], axis=1)
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)
    return nodes, weights


def bending() -> Array:
    """Normal matrix (nodes, nodes) of the second differences over a picture."""
    along, across = (np.diff(np.eye(count), 2, axis=0) for count in GRID[::-1])
    bend = np.vstack([np.kron(np.eye(GRID[0]), along), np.kron(across, np.eye(GRID[1]))])
    return bend.T @ bend / _BEND_SIGMA**2


def around_zero() -> Array:
    """Normal matrix (nodes, nodes) of a smooth pattern around 0."""
    return bending() + np.eye(GRID[0] * GRID[1]) / _NODE_SIGMA**2


def _prior(cameras: int, fall_off_sigma: float) -> Array:
    """Normal matrix of smooth patterns around 0, and of a fall-off, last."""
    return block_diag(*[around_zero()] * cameras, np.array([[fall_off_sigma**-2]]))


def _typical(nodes: Array, camera_of: NDArray[np.int64], cameras: int) -> tuple[Array, Array]:
    """Weights, and weights times values, (nodes + 1, 3), of each camera's median picture."""
    size = GRID[0] * GRID[1]
    pull, pulled = np.zeros((size * cameras + 1, 3)), np.zeros((size * cameras + 1, 3))
    for camera in range(cameras):
        pictures = nodes[camera_of == camera].reshape(-1, size, 3)
        known = np.isfinite(pictures)
        count = known.sum(axis=0)
        total = np.where(known, pictures, 0.0).sum(axis=1, keepdims=True)
        relative = pictures - total / np.maximum(known.sum(axis=1, keepdims=True), 1)
        usual = count >= _MIN_PICTURES
        middle = np.nanmedian(np.where(usual & ~known, np.nan, np.nan_to_num(relative)), axis=0)
        at = slice(camera * size, (camera + 1) * size)
        pull[at] = np.where(usual, count, 0.0) / _SCENE_SIGMA**2
        pulled[at] = pull[at] * middle
    return pull, pulled


def _brightness(nodes: Array, camera_of: NDArray[np.int64], cameras: int) -> tuple[Array, Array]:
    """How much brighter pictures are than their camera's others, (V, 3); whether known, (V,).

    Only nodes that a camera's pictures have in common are compared.
    """
    found, known_gain = np.zeros((len(nodes), 3)), np.zeros(len(nodes))
    for camera in range(cameras):
        mine = np.flatnonzero(camera_of == camera)
        pictures = nodes[mine].reshape(len(mine), -1, 3)
        usual = np.isfinite(pictures).all(axis=2).sum(axis=0) >= _MIN_PICTURES
        above = pictures[:, usual] - np.nanmedian(pictures[:, usual], axis=0)
        shown: NDArray[np.bool_] = np.asarray(np.isfinite(above).all(axis=2))
        count = np.count_nonzero(shown, axis=1)
        known = np.flatnonzero(count > _MIN_SHOWN * pictures.shape[1])
        if len(known):
            total = np.where(shown[..., None], above, 0.0).sum(axis=1)
            mean = total[known] / count[known, None]
            found[mine[known]] = mean - mean.mean(axis=0)
            known_gain[mine[known]] = 1.0
    return found, known_gain


def at_nodes(
    low: NDArray[np.float32],
    limits: tuple[float, float] = (_DARKEST, _BRIGHTEST),
    valid: NDArray[np.float32] | None = None,
) -> Array:
    """Logarithm of a low-passed picture at the nodes, (rows, columns, 3); NaN where dark or burnt.

    The outermost nodes take what is shown a little inside of the edge.

    Args:
        low: the picture.
        limits: levels beyond which it is dark or burnt.
        valid: (h, w) share of each pixel that may be used; None for 1.
    """
    x, y = np.meshgrid(np.linspace(0.01, 0.99, GRID[1]), np.linspace(0.01, 0.99, GRID[0]))
    places = np.column_stack([x.ravel(), y.ravel()]).astype(np.float32)
    level = at_places(low, places).reshape(*GRID, 3).astype(np.float64)
    usable = ((level > limits[0]) & (level < limits[1])).all(axis=-1, keepdims=True)
    if valid is not None:
        usable &= at_places(valid[..., None], places, 1).reshape(*GRID, 1) > 0.5
    return np.where(usable, np.log(np.maximum(level, limits[0])), np.nan)


def _white(
    parts: SampleParts, light: LightModel, images: Sequence[str], cameras: Sequence[str]
) -> Array:
    """Factors that make what is bright neutral, and the survey light without burning out."""
    count = len(parts.items)
    rows = slice(None, None, -(-count // _WHITE_PARTS))  # one step, so that all parts count alike
    kept = joined_samples(list(parts.map(LightSamples.part, [rows] * count)))
    if not len(kept.views):
        return np.ones(3)
    nodes, weights = node_weights(kept.places[:, 0])
    own, view = np.unique(kept.views[:, 0], return_inverse=True)
    factors = np.stack([light.factors(cameras[n], images[n]).reshape(-1, 3) for n in own])
    lift = (factors[view[:, None], nodes] * weights[..., None]).sum(axis=1)
    level = np.exp(kept.levels[:, 0]) * lift
    neutral = neutral_factors(level)
    return neutral * brightening(level * neutral, _WHITE_LEVEL, _GREY_LEVEL)


def neutral_factors(level: Array) -> Array:
    """Factors (3,) that make what is bright in colours (N, 3) neutral.

    The cast is the 6-norm of each colour, between the mean (grey world, which paints a lawn
    purple) and the largest value ("shades of gray", Finlayson & Trezzi 2004).
    """
    cast = (level**_NORM).mean(axis=0) ** (1.0 / _NORM)
    return np.asarray(cast.mean() / cast)


def brightening(level: Array, bright: float, middle: float) -> float:
    """The factor that takes colours (N, 3) up to a bright and a middle level, but above neither."""
    grey = level.mean(axis=1)
    return float(min(bright / np.percentile(grey, BRIGHT_PERCENT), middle / np.median(grey)))


def write_light(path: Path, light: LightModel) -> None:
    """Write `light.json`."""
    write_json(
        path,
        {
            "format": "alice-survey light",
            "version": 1,
            "channels": ["blue", "green", "red"],
            "white": [round(float(w), 6) for w in light.white],
            "patterns": {n: np.round(p, 5).tolist() for n, p in sorted(light.patterns.items())},
            "gains": {n: np.round(g, 5).tolist() for n, g in sorted(light.gains.items())},
        },
    )


def read_light(path: Path) -> LightModel:
    """Read `light.json`.

    Raises:
        WorkspaceError: it is missing, or not as it was written.
    """
    data = read_json(path)
    with taken_from(path):
        return LightModel(
            patterns={n: np.array(p, dtype=np.float64) for n, p in data["patterns"].items()},
            gains={n: np.array(g, dtype=np.float64) for n, g in data["gains"].items()},
            white=np.array(data["white"], dtype=np.float64),
        )


def solve_robustly(
    parts: LinearParts, views: Sequence[NDArray[np.int64]], priors: Sequence[LightPrior]
) -> tuple[Array, Array, Array]:
    """Nodes and fall-off (P + 1, 3), gains (V, 3), and the variance of the fall-off (3,).

    Errors above `misfit` count by their size instead of its square (Huber's weights are 1 below and
    fall as its inverse above).

    Args:
        parts: equations of the samples.
        views: (v,) of each part.
        priors: of every channel: what holds without samples.
    """
    unknowns, pictures = len(priors[0].right), len(priors[0].gain)
    size = unknowns + pictures
    solution, variance = np.zeros((size, 3)), np.full(3, np.inf)
    places = [np.concatenate([np.arange(unknowns), unknowns + own]) for own in views]
    for _ in range(_ROUNDS):
        normal, right = [csr_array((size, size)) for _ in priors], np.zeros((size, 3))
        steps = (solution[place] for place in places)
        for place, part in zip(places, parts.map(_sums_of_part, steps), strict=True):
            for channel, (matrix, side) in enumerate(part):
                entries = matrix.tocoo()
                at = place[entries.row], place[entries.col]
                normal[channel] = normal[channel] + csr_array((entries.data, at), (size, size))
                right[place, channel] += side
        for channel, prior in enumerate(priors):
            solution[:, channel], variance[channel] = _solve_channel(
                normal[channel], right[:, channel], prior
            )
    return solution[:unknowns], solution[unknowns:], variance


def _solve_channel(normal: csr_array, right: Array, prior: LightPrior) -> tuple[Array, float]:
    """Nodes, fall-off and gains of a channel, and the variance of the fall-off."""
    unknowns = len(prior.right)
    mixed = normal[:unknowns, unknowns:]
    block = splu(csc_array(normal[unknowns:, unknowns:] + diags_array(prior.gain)))
    solved = block.solve(np.column_stack([mixed.T.toarray(), right[unknowns:] + prior.gain_right]))
    taken = mixed @ solved
    dense = normal[:unknowns, :unknowns].toarray() + prior.patterns - taken[:, :-1]
    last = np.zeros(unknowns)
    last[-1] = 1.0
    ends = right[:unknowns] + prior.right - taken[:, -1]
    both = solve_symmetric(dense, np.column_stack([ends, last]))
    gains = solved[:, -1] - (solved[:, :-1] * both[:, 0]).sum(axis=1)
    return np.concatenate([both[:, 0], gains]), float(both[-1, 1])


def _sums_of_part(e: LightEquations, solution: Array) -> list[tuple[csr_array, Array]]:
    """Normal matrix and right side of every channel, reweighted at a solution."""
    found = []
    for channel in range(3):
        target, misfit = e.target[:, channel], e.misfit[:, channel]
        rest = np.abs(target - e.matrix @ solution[:, channel])
        weight = 1.0 / (np.maximum(rest, misfit) * misfit * SAMPLES_PER_FACT)
        weighted = (diags_array(weight) @ e.matrix).T
        found.append(((weighted @ e.matrix).tocsr(), weighted @ target))
    return found
