"""Colour of the sea floor: a reflectance for every point in space, at any resolution.

Detail runs from half a metre to a fifth of a millimetre, below one pixel of the full-size camera
at 2 m (0.42 mm). What is finer than a sample is left out of it, so that pictures do not alias.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array
from alice_survey.sim.seafloor.noise import add_octave, mix, noise, spot

Floats = NDArray[np.float32]

FINEST_M = 0.0002
_BLOCK = 4096
_SEED_STREAM = 3200

_COARSE = np.array([[0.52, 0.5], [0.23, 0.45], [0.10, 0.45]])
"""(lattice in metres, weight): patches of organic film and of moisture in the sand."""
_FINE = np.array([
    [0.045, 0.40], [0.020, 0.42], [0.009, 0.42], [0.004, 0.40], [0.0018, 0.50], [0.0008, 0.50],
    [0.0004, 0.45], [FINEST_M, 0.35],
])  # fmt: skip
"""Pits, burrows and pellets down to grains of sand; about as strong in every octave, as natural
pictures are."""
_GROWTH = np.array([[0.13, 0.75], [0.042, 0.5], [0.014, 0.35]])
"""Pattern of algae and crusts on hard ground."""
_SPECKS = np.array([[0.0036, 0.45], [0.012, 0.50], [0.032, 0.45], [0.085, 0.30]])
"""(cell in metres, share of cells): shells and pebbles, and their fragments."""

SAND_ALBEDO = np.array([0.40, 0.345, 0.255])
"""Mean of red, green and blue of bare sand."""


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Reflectance of everything on the sea floor."""

    seed: int
    """32 bits."""

    def albedo(self, points_ned: Array, material: Floats, footprint_m: Floats) -> Floats:
        """Reflectance in red, green and blue, linear, 0 to 1.

        Args:
            points_ned: (N, 3) metres.
            material: (N,) -1 detritus, 0 sand, 1 rock, 2 ceramic, as in `terrain`.
            footprint_m: (N,) distance between neighbouring samples on the surface.

        Returns:
            (N, 3) float32.
        """
        out = np.empty((len(points_ned), 3), dtype=np.float32)
        _albedo(
            np.ascontiguousarray(points_ned, dtype=np.float64),
            np.ascontiguousarray(material, dtype=np.float32),
            np.ascontiguousarray(footprint_m, dtype=np.float32),
            self.seed,
            out,
        )
        return out


def survey_texture(seed: int) -> Texture:
    """The one texture of a survey with a seed."""
    rng = np.random.default_rng([seed, _SEED_STREAM])
    return Texture(seed=int(rng.integers(2**32)))


@compiled(inline="always")
def _step(low: float, high: float, x: float) -> float:
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@compiled
def _octaves(
    table: Array, seed: int, x: Array, y: Array, z: Array, footprint: Array, out: Array
) -> None:
    scratch = np.empty(len(out), np.float32)
    out[:] = np.float32(0.0)
    finest = footprint.min()
    for k in range(len(table)):
        if table[k, 0] > 2.0 * finest:
            noise(x, y, z, table[k, 0], mix(np.uint32(seed + 101 * k)), scratch)
            add_octave(out, scratch, table[k, 0], table[k, 1], footprint)


@compiled
def _albedo(points: Array, material: Array, footprint: Array, seed: int, out: Array) -> None:
    for start in range(0, len(points), _BLOCK):
        stop = min(start + _BLOCK, len(points))
        x, y, z = (
            points[start:stop, 0].copy(),
            points[start:stop, 1].copy(),
            points[start:stop, 2].copy(),
        )
        apart = footprint[start:stop]
        coarse, fine = np.empty(stop - start, np.float32), np.empty(stop - start, np.float32)
        growth, hue = np.empty(stop - start, np.float32), np.empty(stop - start, np.float32)
        _octaves(_COARSE, seed, x, y, z, apart, coarse)
        _octaves(_FINE, seed + 7, x, y, z, apart, fine)
        _octaves(_GROWTH[:2], seed + 17, x, y, z, apart, hue)
        if material[start:stop].max() > 0.001:
            _octaves(_GROWTH, seed + 13, x, y, z, apart, growth)
        for i in range(stop - start):
            at = start + i
            kind = material[at]
            if kind > 1.5:
                r, g, b = _ceramic(coarse[i], fine[i], growth[i], hue[i])
            else:
                r, g, b = _sand(coarse[i], fine[i], hue[i], max(-kind, 0.0))
                # The edge of a stone is ragged, not the smooth contour of the grid.
                stone = _step(0.44, 0.56, kind + 0.3 * fine[i]) if kind > 0.001 else 0.0
                if stone < 1.0:
                    r, g, b = _specked(x[i], y[i], z[i], apart[i], seed, fine[i], r, g, b)
                if stone > 0.0:
                    rr, rg, rb = _rock(coarse[i], fine[i], growth[i], hue[i])
                    r, g, b = r + stone * (rr - r), g + stone * (rg - g), b + stone * (rb - b)
            out[at, 0] = min(max(r, 0.01), 0.95)
            out[at, 1] = min(max(g, 0.01), 0.95)
            out[at, 2] = min(max(b, 0.01), 0.95)


@compiled(inline="always")
def _sand(coarse: float, fine: float, hue: float, detritus: float) -> tuple[float, float, float]:
    film = 0.45 * _step(0.1, 0.75, coarse + 0.25 * hue - 0.2 * fine)
    film = max(film, 0.6 * _step(0.2, 1.1, detritus - 0.5 * fine + 0.35 * coarse))
    level = 1.0 + 0.12 * coarse + 0.30 * fine
    r = level * (0.41 + 0.035 * hue) * (1.0 - film * 0.62)
    g = level * 0.355 * (1.0 - film * 0.52)
    b = level * (0.262 - 0.03 * hue) * (1.0 - film * 0.55)
    return r, g, b


@compiled(inline="always")
def _rock(coarse: float, fine: float, growth: float, hue: float) -> tuple[float, float, float]:
    level = 1.0 + 0.2 * coarse + 0.42 * fine
    r, g, b = 0.225 * level, 0.200 * level, 0.160 * level
    turf = 0.8 * _step(0.0, 0.5, growth + 0.2 * fine)
    level = 1.0 + 0.6 * fine
    r, g, b = (
        r + turf * (0.085 * level - r),
        g + turf * (0.10 * level - g),
        b + turf * (0.042 * level - b),
    )
    crust = 0.6 * _step(0.35, 0.6, -growth - 0.25 * hue + 0.15 * fine)
    level = 1.0 + 0.35 * fine
    return (
        r + crust * (0.37 * level - r),
        g + crust * (0.215 * level - g),
        b + crust * (0.20 * level - b),
    )


@compiled(inline="always")
def _ceramic(coarse: float, fine: float, growth: float, hue: float) -> tuple[float, float, float]:
    level = 1.0 + 0.12 * coarse + 0.4 * fine
    r, g, b = (0.46 + 0.03 * hue) * level, 0.255 * level, 0.158 * level
    silt = 0.55 * _step(-0.4, 0.7, hue + 0.8 * fine)
    r, g, b = r + silt * (0.36 - r), g + silt * (0.30 - g), b + silt * (0.215 - b)
    turf = 0.6 * _step(0.1, 0.8, growth + 0.5 * fine)
    r, g, b = r + turf * (0.13 - r), g + turf * (0.135 - g), b + turf * (0.07 - b)
    worms = 0.6 * _step(0.65, 1.0, 0.6 * fine - growth)
    return r + worms * (0.62 - r), g + worms * (0.58 - g), b + worms * (0.50 - b)


@compiled(inline="always")
def _specked(
    x: float, y: float, z: float, apart: float, seed: int, fine: float, r: float, g: float, b: float
) -> tuple[float, float, float]:
    for k in range(len(_SPECKS)):
        if _SPECKS[k, 0] < 3.0 * apart:
            continue
        cover, back, gloom, own = spot(
            x,
            y,
            z,
            _SPECKS[k, 0],
            _SPECKS[k, 1],
            apart,
            0.2 * abs(fine),
            np.uint32(seed + 31 * k + 1000),
        )
        if gloom > 0.0:
            shade = 1.0 - 0.45 * gloom
            r, g, b = r * shade, g * shade, b * shade
        if cover > 0.0:
            tone = 0.6 + 0.6 * ((own >> np.uint32(4)) & np.uint32(255)) / 255.0
            tone *= (0.45 + 0.55 * back) * (1.0 + 0.3 * fine)
            sort = own & np.uint32(15)
            if sort < 6:  # shell
                sr, sg, sb = 0.68 * tone, 0.63 * tone, 0.54 * tone
            elif sort < 10:  # grey stone
                sr, sg, sb = 0.23 * tone, 0.215 * tone, 0.19 * tone
            elif sort < 14:  # brown stone
                sr, sg, sb = 0.32 * tone, 0.25 * tone, 0.17 * tone
            else:  # weed
                sr, sg, sb = 0.13 * tone, 0.145 * tone, 0.07 * tone
            r, g, b = r + cover * (sr - r), g + cover * (sg - g), b + cover * (sb - b)
    return r, g, b
