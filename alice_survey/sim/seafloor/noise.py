"""Gradient noise in space: the same value at the same place, in any order of evaluation.

Improved noise after Perlin (2002), with gradients from an integer hash of the lattice point, so
that it needs no table and has no period. Loops are written so that the compiler vectorises them.
"""

import math

import numpy as np

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
    inverse, one = 1.0 / lattice_m, _F(1.0)
    scale = _F(2.5 / 511.5)
    key = _U(seed)
    for i in range(out.shape[0]):
        px, py, pz = x[i] * inverse, y[i] * inverse, z[i] * inverse
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
        n0, n2, n4, n6 = (
            n0 + u * (n1 - n0),
            n2 + u * (n3 - n2),
            n4 + u * (n5 - n4),
            n6 + u * (n7 - n6),
        )
        n0, n4 = n0 + v * (n2 - n0), n4 + v * (n6 - n4)
        out[i] = scale * (n0 + w * (n4 - n0))


@compiled(fastmath=True)
def add_octave(
    total: Array, scratch: Array, lattice_m: float, amplitude: float, footprint_m: Array
) -> None:
    """Add `amplitude` times noise to a total, faded out where samples are too far apart for it.

    Args:
        total: (N,) float32, changed in place.
        scratch: (N,) what `noise` gave.
        lattice_m: its lattice.
        amplitude: its weight where samples are dense.
        footprint_m: (N,) float32 distance between samples; none of the octave is left where the
            lattice is two footprints or less, all of it from four on.
    """
    for i in range(total.shape[0]):
        t = _F(lattice_m) / (_F(2.0) * footprint_m[i]) - _F(1.0)
        t = min(max(t, _F(0.0)), _F(1.0))
        total[i] += _F(amplitude) * scratch[i] * (t * t * (_F(3.0) - _F(2.0) * t))


@compiled
def spot(
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
