"""Colour of the sea floor: a reflectance for every point in space, at any resolution.

Detail runs from half a metre to a fifth of a millimetre, below one pixel of the full-size camera
at 2 m (0.42 mm). What is finer than a sample is left out of it, so that pictures do not alias.

Gradient noise in space: the same value at the same place, in any order of evaluation.

Improved noise after Perlin (2002), with gradients from an integer hash of the lattice point, so
that it needs no table and has no period. Loops are written so that the compiler vectorises them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.compiled import compiled
from alice_survey.core.frames import Array

_U, _F = np.uint32, np.float32
_PRIME_X, _PRIME_Y, _PRIME_Z = _U(0x8DA6B343), _U(0xD8163841), _U(0xCB1AB31F)
_SHIFT = 2.0**30
"""Added before rounding down, so that truncation is rounding down for negative numbers too."""


@compiled(inline="always")
def mix(h: np.uint32) -> np.uint32:
    """Spread the bits of a 32-bit integer over all of its bits."""
    h = _U(h ^ (h >> _U(15)))
    h = _U(h * _U(0x2C1B3C6D))
    h = _U(h ^ (h >> _U(12)))
    h = _U(h * _U(0x297A2D39))
    return _U(h ^ (h >> _U(15)))


@compiled(inline="always")
def _corner(h: np.uint32, x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    h = mix(h)
    gx = _F(np.int32(h & _U(1023))) - _F(511.5)
    gy = _F(np.int32((h >> _U(10)) & _U(1023))) - _F(511.5)
    gz = _F(np.int32((h >> _U(20)) & _U(1023))) - _F(511.5)
    return gx * x + gy * y + gz * z


@compiled(inline="always")
def _fade(t: np.float32) -> np.float32:
    return t * t * t * (t * (t * _F(6.0) - _F(15.0)) + _F(10.0))


@compiled(inline="always")
def _noise_at(x: float, y: float, z: float, per_m: float, key: np.uint32) -> np.float32:
    one = _F(1.0)
    px, py, pz = x * per_m, y * per_m, z * per_m
    ix = np.int32(np.int32(px + _SHIFT) - np.int32(_SHIFT))
    iy = np.int32(np.int32(py + _SHIFT) - np.int32(_SHIFT))
    iz = np.int32(np.int32(pz + _SHIFT) - np.int32(_SHIFT))
    a, b, c = _F(px - np.float64(ix)), _F(py - np.float64(iy)), _F(pz - np.float64(iz))
    x0, y0, z0 = _U(_U(ix) * _PRIME_X), _U(_U(iy) * _PRIME_Y), _U(_U(iz) * _PRIME_Z)
    x1, y1, z1 = _U(x0 + _PRIME_X), _U(y0 + _PRIME_Y), _U(z0 + _PRIME_Z)
    x0, x1 = _U(x0 ^ key), _U(x1 ^ key)
    a1, b1, c1 = a - one, b - one, c - one
    u, v, w = _fade(a), _fade(b), _fade(c)
    n0, n1 = _corner(_U(x0 ^ y0 ^ z0), a, b, c), _corner(_U(x1 ^ y0 ^ z0), a1, b, c)
    n2, n3 = _corner(_U(x0 ^ y1 ^ z0), a, b1, c), _corner(_U(x1 ^ y1 ^ z0), a1, b1, c)
    n4, n5 = _corner(_U(x0 ^ y0 ^ z1), a, b, c1), _corner(_U(x1 ^ y0 ^ z1), a1, b, c1)
    n6, n7 = _corner(_U(x0 ^ y1 ^ z1), a, b1, c1), _corner(_U(x1 ^ y1 ^ z1), a1, b1, c1)
    n0, n2 = n0 + u * (n1 - n0), n2 + u * (n3 - n2)
    n4, n6 = n4 + u * (n5 - n4), n6 + u * (n7 - n6)
    n0, n4 = n0 + v * (n2 - n0), n4 + v * (n6 - n4)
    return _F(2.5 / 511.5) * (n0 + w * (n4 - n0))


@compiled(fastmath=True)
def noise(x: Array, y: Array, z: Array, lattice_m: float, seed: int, out: Array) -> None:
    """Fill `out` with noise of standard deviation about 0.48 and mean 0.

    Args:
        x: (N,) metres; any three axes, any origin within 2**30 lattice steps.
        y: (N,).
        z: (N,).
        lattice_m: spacing of the lattice; the noise has hardly any energy at shorter wavelengths.
        seed: 32 bits.
        out: (N,) float32.
    """
    per_m, key = 1.0 / lattice_m, _U(seed)
    for i in range(out.shape[0]):
        out[i] = _noise_at(x[i], y[i], z[i], per_m, key)


@compiled(fastmath=True, error_model="numpy")
def add_octave(
    total: Array,
    x: Array,
    y: Array,
    z: Array,
    lattice_m: float,
    seed: int,
    amplitude: float,
    footprint_m: Array,
) -> None:
    """Add `amplitude` times `noise` to a total, faded out where samples are too far apart for it.

    Args:
        total: (N,) float32, changed in place.
        x: see `noise`, like y, z, lattice_m and seed.
        y: see x.
        z: see x.
        lattice_m: see x.
        seed: see x.
        amplitude: its weight where samples are dense.
        footprint_m: (N,) float32 distance between samples; none of the octave is left where the
            lattice is two footprints or less, all of it from four on.
    """
    per_m, key = 1.0 / lattice_m, _U(seed)
    for i in range(total.shape[0]):
        t = _F(lattice_m) / (_F(2.0) * footprint_m[i]) - _F(1.0)
        t = min(max(t, _F(0.0)), _F(1.0))
        weight = _F(amplitude) * (t * t * (_F(3.0) - _F(2.0) * t))
        total[i] += weight * _noise_at(x[i], y[i], z[i], per_m, key)


@compiled
def speck(
    x: float,
    y: float,
    z: float,
    cell_m: float,
    share: float,
    footprint_m: float,
    rough: float,
    seed: int,
) -> tuple[float, float, float, np.uint32]:
    """A speck (a shell, a pebble): ellipsoids, at most one in each cell of a cubic lattice.

    Args:
        x: metres.
        y: metres.
        z: metres.
        cell_m: size of a cell; radii are 0.06 to 0.26 of it.
        share: how many of the cells hold a speck.
        footprint_m: over how much its edge is softened.
        rough: share of its radius by which the outline is drawn in here.
        seed: 32 bits.

    Returns:
        How much of the footprint it covers (0 to 1), height of the place on its round back (0 at
        the edge, 1 on top), the gloom of the ground close around it (0 to 1), and 16 random bits of
        the speck's own.
    """
    ix, iy, iz = math.floor(x / cell_m), math.floor(y / cell_m), math.floor(z / cell_m)
    h = _U(_U(ix) * _PRIME_X) ^ _U(_U(iy) * _PRIME_Y) ^ _U(_U(iz) * _PRIME_Z)
    h = mix(_U(h ^ _U(seed)))
    if (h & _U(1023)) >= share * 1024.0:
        return 0.0, 0.0, 0.0, _U(0)
    own = mix(_U(h + _U(0x9E3779B9)))
    radius = cell_m * (0.06 + 0.2 * ((own & _U(255)) / 255.0) ** 2)
    long = 1.0 + 0.6 * ((own >> _U(8)) & _U(255)) / 255.0
    # The centre stays so far inside that no speck is cut by its cell.
    room = 1.0 - min(2.0 * radius * long * 1.3 / cell_m, 1.0)
    dx = x - (ix + 0.5 + room * (((h >> _U(10)) & _U(127)) / 127.0 - 0.5)) * cell_m
    dy = y - (iy + 0.5 + room * (((h >> _U(17)) & _U(127)) / 127.0 - 0.5)) * cell_m
    dz = z - (iz + 0.5 + room * (((h >> _U(24)) & _U(127)) / 127.0 - 0.5)) * cell_m
    angle = 2.0 * math.pi * ((own >> _U(16)) & _U(255)) / 255.0
    c, s = math.cos(angle), math.sin(angle)
    along, across = (c * dx + s * dy) / long, (c * dy - s * dx) * long
    distance = math.sqrt(along * along + across * across + dz * dz) * (1.0 + rough)
    edge = max(footprint_m, 0.06 * radius)
    cover = min(max((radius - distance) / edge + 0.5, 0.0), 1.0)
    cover *= min(1.0, (2.0 * radius / footprint_m) ** 2)
    back = max(1.0 - (distance / radius) ** 2, 0.0)
    gloom = max(1.0 - max(distance / radius - 1.0, 0.0) / 0.5, 0.0)
    return cover, math.sqrt(back), gloom * gloom, _U(mix(_U(own + _U(77))) & _U(0xFFFF))


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
    out[:] = np.float32(0.0)
    finest = footprint.min()
    for k in range(len(table)):
        if table[k, 0] > 2.0 * finest:
            key = mix(np.uint32(seed + 101 * k))
            add_octave(out, x, y, z, table[k, 0], key, table[k, 1], footprint)


@compiled
def _albedo(points: Array, material: Array, footprint: Array, seed: int, out: Array) -> None:
    for start in range(0, len(points), _BLOCK):
        stop = min(start + _BLOCK, len(points))
        x, y, z = (
            points[start:stop, 0].copy(),
            points[start:stop, 1].copy(),
            points[start:stop, 2].copy(),
        )
        apart, kind = footprint[start:stop], material[start:stop]
        coarse, fine = np.empty(stop - start, np.float32), np.empty(stop - start, np.float32)
        growth, hue = np.empty(stop - start, np.float32), np.empty(stop - start, np.float32)
        _octaves(_COARSE, seed, x, y, z, apart, coarse)
        _octaves(_FINE, seed + 7, x, y, z, apart, fine)
        _octaves(_GROWTH[:2], seed + 17, x, y, z, apart, hue)
        colours = np.empty((3, stop - start))
        _sand(coarse, fine, hue, kind, colours[0], colours[1], colours[2])
        _add_specks(x, y, z, apart, seed, fine, colours)
        if kind.max() > 0.001:
            _octaves(_GROWTH, seed + 13, x, y, z, apart, growth)
            for i in range(stop - start):
                if kind[i] > 0.001:
                    r, g, b = colours[:, i]
                    colours[0, i], colours[1, i], colours[2, i] = _stone(
                        kind[i], coarse[i], fine[i], growth[i], hue[i], r, g, b
                    )
        for i in range(stop - start):
            for channel in range(3):
                out[start + i, channel] = min(max(colours[channel, i], 0.01), 0.95)


@compiled
def _sand(
    coarse: Array, fine: Array, hue: Array, kind: Array, red: Array, green: Array, blue: Array
) -> None:
    for i in range(len(coarse)):
        film = 0.45 * _step(0.1, 0.75, coarse[i] + 0.25 * hue[i] - 0.2 * fine[i])
        detritus = max(-kind[i], 0.0) - 0.5 * fine[i] + 0.35 * coarse[i]
        film = max(film, 0.6 * _step(0.2, 1.1, detritus))
        level = 1.0 + 0.12 * coarse[i] + 0.30 * fine[i]
        red[i] = level * (0.41 + 0.035 * hue[i]) * (1.0 - film * 0.62)
        green[i] = level * 0.355 * (1.0 - film * 0.52)
        blue[i] = level * (0.262 - 0.03 * hue[i]) * (1.0 - film * 0.55)


@compiled(inline="always")
def _stone(
    kind: float, coarse: float, fine: float, growth: float, hue: float, r: float, g: float, b: float
) -> tuple[float, float, float]:
    if kind > 1.5:
        level = 1.0 + 0.12 * coarse + 0.4 * fine
        r, g, b = (0.46 + 0.03 * hue) * level, 0.255 * level, 0.158 * level
        silt = 0.55 * _step(-0.4, 0.7, hue + 0.8 * fine)
        r, g, b = r + silt * (0.36 - r), g + silt * (0.30 - g), b + silt * (0.215 - b)
        turf = 0.6 * _step(0.1, 0.8, growth + 0.5 * fine)
        r, g, b = r + turf * (0.13 - r), g + turf * (0.135 - g), b + turf * (0.07 - b)
        worms = 0.6 * _step(0.65, 1.0, 0.6 * fine - growth)
        return r + worms * (0.62 - r), g + worms * (0.58 - g), b + worms * (0.50 - b)
    # The edge of a stone is ragged, not the smooth contour of the grid.
    stone = _step(0.44, 0.56, kind + 0.3 * fine)
    rr, rg, rb = _rock(coarse, fine, growth, hue)
    return r + stone * (rr - r), g + stone * (rg - g), b + stone * (rb - b)


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


@compiled
def _add_specks(
    x: Array, y: Array, z: Array, apart: Array, seed: int, fine: Array, colours: Array
) -> None:
    near = np.empty(len(x), np.bool_)
    finest = apart.min()
    for k in range(len(_SPECKS)):
        cell_m, share, key = _SPECKS[k, 0], _SPECKS[k, 1], np.uint32(seed + 31 * k + 1000)
        if cell_m < 3.0 * finest:
            continue
        near_specks(x, y, z, cell_m, share, apart, key, near)
        for i in range(len(x)):
            if not near[i] or cell_m < 3.0 * apart[i]:
                continue
            cover, back, gloom, own = speck(
                x[i], y[i], z[i], cell_m, share, apart[i], 0.2 * abs(fine[i]), key
            )
            r, g, b = colours[:, i]
            if gloom > 0.0:
                shade = 1.0 - 0.45 * gloom
                r, g, b = r * shade, g * shade, b * shade
            if cover > 0.0:
                tone = 0.6 + 0.6 * ((own >> np.uint32(4)) & np.uint32(255)) / 255.0
                tone *= (0.45 + 0.55 * back) * (1.0 + 0.3 * fine[i])
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
            colours[0, i], colours[1, i], colours[2, i] = r, g, b


@compiled(fastmath=True)
def near_specks(
    x: Array, y: Array, z: Array, cell_m: float, share: float, apart: Array, key: int, out: Array
) -> None:
    """Fill `out` with whether a place can be in what `speck` changes: a ball around the speck."""
    per_m, limit = 1.0 / cell_m, np.int32(share * 1024.0)
    for i in range(len(out)):
        px, py, pz = x[i] * per_m, y[i] * per_m, z[i] * per_m
        ix = np.int32(np.int32(px + _SHIFT) - np.int32(_SHIFT))
        iy = np.int32(np.int32(py + _SHIFT) - np.int32(_SHIFT))
        iz = np.int32(np.int32(pz + _SHIFT) - np.int32(_SHIFT))
        h = _U(_U(ix) * _PRIME_X) ^ _U(_U(iy) * _PRIME_Y) ^ _U(_U(iz) * _PRIME_Z)
        h = mix(_U(h ^ _U(key)))
        own = mix(_U(h + _U(0x9E3779B9)))
        size = _F(np.int32(own & _U(255))) / _F(255.0)
        radius = _F(0.06) + _F(0.2) * size * size
        long = _F(1.0) + _F(0.6 / 255.0) * _F(np.int32((own >> _U(8)) & _U(255)))
        room = _F(1.0) - min(_F(2.6) * radius * long, _F(1.0))
        dx = _F(px - np.float64(ix)) - _F(0.5) - room * (_centre(h >> _U(10)))
        dy = _F(py - np.float64(iy)) - _F(0.5) - room * (_centre(h >> _U(17)))
        dz = _F(pz - np.float64(iz)) - _F(0.5) - room * (_centre(h >> _U(24)))
        edge = max(apart[i] * _F(per_m), _F(0.06) * radius)
        reach = _F(1.01) * long * max(_F(1.5) * radius, radius + _F(0.5) * edge)
        held = np.int32(h & _U(1023)) <= limit
        out[i] = held & (dx * dx + dy * dy + dz * dz < reach * reach)


@compiled(inline="always")
def _centre(bits: np.uint32) -> np.float32:
    return _F(np.int32(bits & _U(127))) / _F(127.0) - _F(0.5)
