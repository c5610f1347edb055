"""Points in the water from their pixels in two or more cameras behind flat ports, exactly.

The start is the point nearest to all rays in water (for two rays, the middle of their common
perpendicular). From there the sum of the squared reprojection errors of all cameras is minimised
over the point, by Gauss-Newton with analytic slopes, damped where it must be (Levenberg-Marquardt).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from alice_survey.base.compiled import compiled
from alice_survey.base.errors import CalibrationError
from alice_survey.base.frames import Array
from camera_calib.flat_port import FlatPortCamera
from camera_calib.lens import distort_slopes
from camera_calib.refraction import air_tangent

_STEPS = 200
_SETTLED_PX = 1e-10
"""A full step that would move the pixels by less ends the search."""
_ROUNDING = 1e-11
"""Growth of the squared error, in px^2 or as a share of it, that may be rounding."""
_INSIDE = 1e-4
"""A start out of the water is moved into it by this share of its distance from the camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Triangulation:
    """Points in the water; a row is NaN where there is no solution (see `triangulate`).

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> rig = alice.design_rig(config.camera, config.water)
        >>> cameras, poses = list(rig.cameras.values()), list(rig.cam_from_rig.values())
        >>> pixels = np.stack([c.project(p.apply([[0, 0, 2.0]])) for c, p in zip(cameras, poses)])
        >>> found = alice.triangulate(cameras, poses, pixels, sigma_px=0.1)
        >>> bool(found.sigmas_m[0, 2] < 0.002)
        True
    """

    points_world: Array
    """(N, 3) points of least squared reprojection error, metres."""
    covariance: Array
    """(N, 3, 3) covariances from the noise of the pixels alone, m^2."""
    residuals_px: Array
    """(C, N, 2) projected minus measured; NaN where a camera does not see the point."""
    nearest_world: Array
    """(N, 3) the points nearest to all rays in water: where the search began."""
    nearest_residuals_px: Array
    """(C, N, 2) residuals of these points; NaN also where one is not in the water."""

    @property
    def sigmas_m(self) -> Array:
        """(N, 3) standard deviations from the noise of the pixels alone."""
        sigmas: Array = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))
        return sigmas


def triangulate(
    cameras: Sequence[FlatPortCamera],
    cam_from_world: Sequence[RigidTransform],
    pixels: Array,
    sigma_px: float | Sequence[float] = 1.0,
) -> Triangulation:
    """Find the points that two or more cameras see.

    A row has no solution, and is NaN, where fewer than two cameras see the point, the rays are
    parallel, or the squared error has no minimum in the water beyond every port.

    Args:
        cameras: C cameras.
        cam_from_world: their poses.
        pixels: (C, N, 2); NaN where a camera does not see the point.
        sigma_px: standard deviation of one coordinate of a pixel, of all cameras or of each; it
            weighs cameras against each other and scales the covariance.

    Raises:
        CalibrationError: lists that do not pair, or a sigma that is not positive.

    Example:
        >>> import alice_survey as alice
        >>> config = alice.SurveyConfig()
        >>> rig = alice.design_rig(config.camera, config.water)
        >>> cameras, poses = list(rig.cameras.values()), list(rig.cam_from_rig.values())
        >>> point = np.array([[0.1, 0.2, 2.0]])
        >>> pixels = np.stack([c.project(p.apply(point)) for c, p in zip(cameras, poses)])
        >>> found = alice.triangulate(cameras, poses, pixels, sigma_px=0.1)
        >>> bool(np.allclose(found.points_world, point))
        True
    """
    measured = np.ascontiguousarray(pixels, dtype=np.float64)
    sigmas = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (len(cameras),))
    if measured.ndim != 3 or measured.shape[::2] != (len(cameras), 2):
        raise CalibrationError(
            f"triangulation: pixels {measured.shape} of {len(cameras)} cameras; (C, N, 2) wanted"
        )
    if len(cam_from_world) != len(cameras) or len(cameras) < 2:
        raise CalibrationError(
            f"triangulation: {len(cameras)} cameras and {len(cam_from_world)} poses; two or more "
            "of each are needed"
        )
    if not np.all(np.isfinite(sigmas) & (sigmas > 0)):
        raise CalibrationError(f"triangulation: sigma_px {sigmas.tolist()} must be positive")
    origins, directions = _rays_world(cameras, cam_from_world, measured)
    nearest = nearest_to_rays(origins, directions)
    # Weights relative to the best camera keep the search's own threshold in pixels.
    best = float(sigmas.min())
    rotations = np.stack([pose.rotation.as_matrix() for pose in cam_from_world])
    translations = np.stack([pose.translation for pose in cam_from_world])
    models = [camera.kernel_arguments for camera in cameras]
    points, covariance = _search(
        nearest,
        measured,
        (best / sigmas) ** 2,
        np.stack([lens for lens, _, _ in models]),
        np.stack([port for _, port, _ in models]),
        np.array([fold for _, _, fold in models]),
        rotations,
        translations,
    )
    return Triangulation(
        points_world=points,
        covariance=covariance * best**2,
        residuals_px=reproject(cameras, cam_from_world, points) - measured,
        nearest_world=nearest,
        nearest_residuals_px=reproject(cameras, cam_from_world, nearest) - measured,
    )


def reproject(
    cameras: Sequence[FlatPortCamera], cam_from_world: Sequence[RigidTransform], points_world: Array
) -> Array:
    """Pixels, (C, N, 2), of points (N, 3) in every camera; NaN where it cannot see them."""
    return np.stack(
        [
            camera.project(pose.apply(points_world))
            for camera, pose in zip(cameras, cam_from_world, strict=True)
        ]
    )


def nearest_to_rays(origins: Array, directions: Array) -> Array:
    """The points with the least sum of squared distances to several straight rays.

    Args:
        origins: (C, N, 3) a point of each ray; NaN rays do not count.
        directions: (C, N, 3) unit vectors.

    Returns:
        (N, 3); NaN where fewer than two rays count or they are parallel.
    """
    return np.asarray(
        _nearest(
            np.ascontiguousarray(origins, dtype=np.float64),
            np.ascontiguousarray(directions, dtype=np.float64),
        )
    )


def _rays_world(
    cameras: Sequence[FlatPortCamera], cam_from_world: Sequence[RigidTransform], pixels: Array
) -> tuple[Array, Array]:
    origins, directions = np.empty((2, *pixels.shape[:2], 3))
    for i, (camera, pose) in enumerate(zip(cameras, cam_from_world, strict=True)):
        points_cam, directions_cam = camera.unproject(pixels[i])
        back = pose.rotation.as_matrix()  # rows times the matrix are the inverse rotation
        origins[i] = (points_cam - pose.translation) @ back
        directions[i] = directions_cam @ back
    return origins, directions


@compiled(nogil=True, error_model="numpy")
def _solve(m: Array, g: Array, damping: float, out: Array) -> bool:
    """Solve (m + damping diag(m)) out = g, (3, 3) and symmetric, by Cholesky; False if singular."""
    more = 1.0 + damping
    a, d, f = m[0, 0] * more, m[1, 1] * more, m[2, 2] * more
    if not a > 0.0:
        return False
    l00 = math.sqrt(a)
    l10, l20 = m[1, 0] / l00, m[2, 0] / l00
    rest = d - l10 * l10
    if not rest > 1e-14 * d:
        return False
    l11 = math.sqrt(rest)
    l21 = (m[2, 1] - l20 * l10) / l11
    rest = f - l20 * l20 - l21 * l21
    if not rest > 1e-14 * f:
        return False
    l22 = math.sqrt(rest)
    y0 = g[0] / l00
    y1 = (g[1] - l10 * y0) / l11
    y2 = (g[2] - l20 * y0 - l21 * y1) / l22
    out[2] = y2 / l22
    out[1] = (y1 - l21 * out[2]) / l11
    out[0] = (y0 - l10 * out[1] - l20 * out[2]) / l00
    return True


@compiled(nogil=True, error_model="numpy")
def _nearest(origins: Array, directions: Array) -> Array:
    cameras, count = origins.shape[:2]
    points = np.full((count, 3), np.nan)
    m, g = np.empty((3, 3)), np.empty(3)
    for i in range(count):
        m[:], g[:] = 0.0, 0.0
        rays = 0
        for c in range(cameras):
            o, d = origins[c, i], directions[c, i]
            if not math.isfinite(o[0] + d[0]):
                continue
            rays += 1
            for a in range(3):
                for b in range(3):
                    across = (1.0 if a == b else 0.0) - d[a] * d[b]
                    m[a, b] += across
                    g[a] += across * o[b]
        if rays >= 2 and not _solve(m, g, 0.0, points[i]):
            points[i] = np.nan
    return points


@compiled(nogil=True, error_model="numpy")
def _pixel_slopes(p: Array, lens: Array, port: Array, fold: float, out: Array) -> bool:
    """Pixel of one point and its derivatives by the point, as in `refraction.project_jacobian`.

    Args:
        p: (3,) in the camera's frame.
        lens: as there.
        port: as there.
        fold: as there.
        out: (2, 4), filled: derivatives by x, y, z, then the pixel.

    Returns:
        False where the point has no pixel.
    """
    n = port[4:7]
    along = n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
    water = along - port[0] - port[1]
    if not water > 0.0:
        return False
    ex, ey, ez = p[0] - along * n[0], p[1] - along * n[1], p[2] - along * n[2]
    radius = math.sqrt(ex * ex + ey * ey + ez * ez)
    tangent = 0.0
    turn = 1.0 / (port[0] + port[1] / port[2] + water / port[3])
    if radius > 0.0:
        tangent = air_tangent(radius, water, port)
        turn = tangent / radius
        ex, ey, ez = ex / radius, ey / radius, ez / radius
    dx, dy = turn * radius * ex + n[0], turn * radius * ey + n[1]
    dz = turn * radius * ez + n[2]
    if not dz > 0.0:
        return False
    u, v = dx / dz, dy / dz
    if not u * u + v * v < fold:
        return False
    t2 = tangent * tangent
    n_glass2, n_water2 = port[2] * port[2], port[3] * port[3]
    root_glass = math.sqrt(n_glass2 + (n_glass2 - 1.0) * t2)
    root_water = math.sqrt(n_water2 + (n_water2 - 1.0) * t2)
    steep = port[0] + port[1] * n_glass2 / root_glass**3 + water * n_water2 / root_water**3
    bend, by_h = 1.0 / steep - turn, -tangent / (root_water * steep)
    x, y, x_u, x_v, y_u, y_v = distort_slopes(u, v, lens[4:])
    for j in range(3):
        ej = ex if j == 0 else (ey if j == 1 else ez)
        outward = bend * ej + by_h * n[j]
        sx = outward * ex - turn * n[0] * n[j]
        sy = outward * ey - turn * n[1] * n[j]
        sz = outward * ez - turn * n[2] * n[j]
        if j == 0:
            sx += turn
        elif j == 1:
            sy += turn
        else:
            sz += turn
        u_j, v_j = (sx - u * sz) / dz, (sy - v * sz) / dz
        out[0, j] = lens[0] * (x_u * u_j + x_v * v_j)
        out[1, j] = lens[1] * (y_u * u_j + y_v * v_j)
    out[0, 3], out[1, 3] = lens[0] * x + lens[2], lens[1] * y + lens[3]
    return True


@compiled(nogil=True, error_model="numpy")
def _equations(
    point: Array,
    i: int,
    pixels: Array,
    weights: Array,
    lenses: Array,
    ports: Array,
    folds: Array,
    rotations: Array,
    translations: Array,
    m: Array,
    g: Array,
) -> float:
    """Fill the normal equations m step = g of one point; its cost, inf where it has no pixel."""
    p, s, w = np.empty(3), np.empty((2, 4)), np.empty(3)
    m[:], g[:] = 0.0, 0.0
    cost = 0.0
    for c in range(pixels.shape[0]):
        if not math.isfinite(pixels[c, i, 0] + pixels[c, i, 1]):
            continue
        r = rotations[c]
        for a in range(3):
            p[a] = translations[c, a]
            for b in range(3):
                p[a] += r[a, b] * point[b]
        if not _pixel_slopes(p, lenses[c], ports[c], folds[c], s):
            return math.inf
        for k in range(2):
            miss = s[k, 3] - pixels[c, i, k]
            cost += weights[c] * miss * miss
            for a in range(3):
                w[a] = s[k, 0] * r[0, a] + s[k, 1] * r[1, a] + s[k, 2] * r[2, a]
            for a in range(3):
                g[a] -= weights[c] * w[a] * miss
                for b in range(3):
                    m[a, b] += weights[c] * w[a] * w[b]
    return cost


@compiled(nogil=True, error_model="numpy")
def _into_water(
    point: Array, i: int, pixels: Array, ports: Array, rotations: Array, translations: Array
) -> None:
    """Move a point that is not in the water beyond every port that sees it to just inside."""
    for _ in range(20):
        moved = False
        for c in range(pixels.shape[0]):
            if not math.isfinite(pixels[c, i, 0] + pixels[c, i, 1]):
                continue
            n, r = ports[c, 4:7], rotations[c]
            along, far2 = 0.0, 0.0
            for a in range(3):
                at = translations[c, a]
                for b in range(3):
                    at += r[a, b] * point[b]
                along += n[a] * at
                far2 += at * at
            lacking = ports[c, 0] + ports[c, 1] + _INSIDE * math.sqrt(far2) - along
            if lacking > 0.0:
                moved = True
                for b in range(3):
                    normal = r[0, b] * n[0] + r[1, b] * n[1] + r[2, b] * n[2]
                    point[b] += 2.0 * lacking * normal
        if not moved:
            return


@compiled(nogil=True, error_model="numpy")
def _search(
    starts: Array,
    pixels: Array,
    weights: Array,
    lenses: Array,
    ports: Array,
    folds: Array,
    rotations: Array,
    translations: Array,
) -> tuple[Array, Array]:
    """Points of least cost, (N, 3), and the inverse of their normal matrices, (N, 3, 3)."""
    count = starts.shape[0]
    points = np.full((count, 3), np.nan)
    inverses = np.full((count, 3, 3), np.nan)
    m, g = np.empty((3, 3)), np.empty(3)
    new_m, new_g = np.empty((3, 3)), np.empty(3)
    step, trial, unit = np.empty(3), np.empty(3), np.empty(3)
    for i in range(count):
        point = starts[i].copy()
        if not math.isfinite(point[0]):
            continue
        _into_water(point, i, pixels, ports, rotations, translations)
        cost = _equations(
            point, i, pixels, weights, lenses, ports, folds, rotations, translations, m, g
        )
        damping, settled = 0.0, False
        for _ in range(_STEPS):
            if not (cost < math.inf and _solve(m, g, 0.0, step)):
                break
            change2 = step[0] * g[0] + step[1] * g[1] + step[2] * g[2]
            settled = change2 < _SETTLED_PX * _SETTLED_PX
            if damping > 0.0 and not settled and not _solve(m, g, damping, step):
                break
            for a in range(3):
                trial[a] = point[a] + step[a]
            new_cost = _equations(
                trial, i, pixels, weights, lenses, ports, folds, rotations, translations,
                new_m, new_g,
            )  # fmt: skip
            if new_cost <= cost + _ROUNDING * (1.0 + cost):
                point[:], m[:], g[:] = trial, new_m, new_g
                cost = new_cost
                damping = 0.1 * damping if damping > 1e-4 else 0.0
            else:
                damping = max(1e-3, 10.0 * damping)
            if settled or damping > 1e12:
                break
        if not settled:
            continue
        points[i] = point
        for a in range(3):
            unit[:] = 0.0
            unit[a] = 1.0
            if not _solve(m, unit, 0.0, inverses[i, a]):
                inverses[i] = np.nan
                points[i] = np.nan
                break
    return points, inverses
