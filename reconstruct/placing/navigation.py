"""What navigation measured at the stations of a model, as equations about a placement of it.

Also where the fit of a model to navigation starts, and what of its place navigation can tell.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.block_solver import MAD_TO_SIGMA
from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import warn
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.core.manifest import ImageRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import cross_matrices
from reconstruct.placing.alignment import Similarity

PARAMETERS = 17
"""Number of parameters before the soft modes."""
PLACE = 7
"""Number of parameters of the placement; the rest are nuisances."""
SCALE, TURN, STRETCH, MOUNT, LEVER, CLOCK, DRIFT = 6, 7, 8, slice(9, 12), slice(12, 15), 15, 16
GROUPS = ("horizontal", "depth", "tilt", "heading")
GROUP_OF = ("horizontal", "horizontal", "depth", "tilt", "tilt", "heading")
"""Groups of the six channels: north, east, depth, roll, pitch, heading."""
_NEAR_STEPS = 3.0
"""Usual time steps between stations within which a vehicle's motion is taken as even."""
_USUAL_SIGMAS = (3.0, 3.0, 2.0, 5.0)
"""Horizontal and depth (m), attitude and heading (deg): used where navigation states no sigma."""


@dataclass(frozen=True, kw_only=True)
class Installation:
    """Sigmas of where and when cameras are against navigation's sensors."""

    mount_rad: float
    """Of the mount's rotation about each axis of the body; 0: exact."""
    lever_m: float
    """Of the lever arm along each axis."""
    clock_s: float

    @classmethod
    def of(cls, settings: ReconstructConfig) -> "Installation":
        """As a survey states them."""
        return cls(
            mount_rad=math.radians(settings.mount_sigma_deg),
            lever_m=settings.lever_sigma_m,
            clock_s=settings.clock_sigma_s,
        )

    def weights(self, columns: int) -> Array:
        """(columns,) one over the sigma of each parameter, 0 where it has none."""
        found = np.zeros(columns)
        found[LEVER], found[CLOCK] = 1.0 / self.lever_m, 1.0 / self.clock_s
        if self.mount_rad > 0:
            found[MOUNT] = 1.0 / self.mount_rad
        return found


USUAL_INSTALLATION = Installation.of(ReconstructConfig())


@dataclass(frozen=True, kw_only=True, eq=False)
class Epochs:
    """Navigation at the stations of a model, by time: N pictures at M times."""

    time: Array
    """(M,) seconds, or the station's number where a time is unknown."""
    timed: bool
    """Whether `time` is in seconds."""
    moment: NDArray[np.int64]
    """(N,) which time each picture belongs to."""
    centres: Array
    """(N, 3) camera centres in the model."""
    model_from_body: Rotation
    """(N,) attitudes in the model."""
    levers: Array
    """(N, 3) body origin minus camera centre, in the body frame, metres."""
    measured_ned: Array
    """(N, 3) positions of the body's origin."""
    ned_from_body: Rotation
    """(N,) measured; the identity where unknown."""
    sigma: Array
    """(M, 6) north, east, depth (m), roll, pitch, heading (rad) as navigation states it."""
    known: NDArray[np.bool_]
    """(M, 6) whether navigation gives the value."""
    modes: Array
    """(N, 6, K) by the model's soft modes: motions of the centres, and turns about its axes."""

    def deform(self, sizes: Array) -> "Epochs":
        """The same of the model with its soft modes (K,) of these sizes."""
        steps = self.modes @ sizes
        return replace(
            self,
            centres=self.centres + steps[:, :3],
            model_from_body=Rotation.from_rotvec(steps[:, 3:]) * self.model_from_body,
        )

    def positions(self, ned_from_model: Similarity) -> Array:
        """Body origins in NED, (N, 3)."""
        arms = (ned_from_model.rotation * self.model_from_body).apply(self.levers)
        return np.asarray(ned_from_model.apply(self.centres) + arms)

    @property
    def has_attitude(self) -> bool:
        """Whether any roll, pitch or heading is known."""
        return bool(self.known[:, 3:].any())

    @property
    def has_tilt(self) -> bool:
        """Whether any roll and pitch are known together."""
        return bool(np.any(self.known[:, 3] & self.known[:, 4]))

    @property
    def has_horizontal(self) -> bool:
        """Whether any north and east are known."""
        return bool(self.known[:, 0].any())


def body_from_pinhole(rig: Rig, warps: Mapping[str, PinholeWarp]) -> dict[str, RigidTransform]:
    """Mounts of the pinholes, metres."""
    return {
        name: rig.body_from_cam(name) * warp.pinhole_from_cam.inv() for name, warp in warps.items()
    }


def read_epochs(
    records: Sequence[ImageRecord],
    model_from_cam: Sequence[RigidTransform],
    body_from_cam: Mapping[str, RigidTransform] | None,
    datum: Datum | None,
    modes: Array | None = None,
    *,
    measured: bool = True,
) -> Epochs:
    """Collect what navigation measured, if it is asked; nothing is `known` where it says nothing.

    Every channel helps on its own, but latitude and longitude together only. Without a datum these
    are not used.

    `modes` are those of all pictures, (N, 6, K); None where the model is stiff.

    Pictures of one station share one reading of navigation, which must not count twice. Without
    `body_from_cam` positions are those of the cameras, and what attitudes mean for them is unknown.
    """
    readings = np.array([_readings(r) for r in records])
    if datum is None:
        readings[:, :2] = np.nan
    if body_from_cam is None:
        readings[:, 3:] = np.nan
    if not measured:
        readings[:] = np.nan
    chosen = np.flatnonzero(np.isfinite(readings).any(axis=1)).tolist()
    timed = bool(chosen) and all(np.isfinite(records[i].time_s) for i in chosen)
    chosen = sorted(
        chosen or range(len(records)),
        key=lambda i: (records[i].time_s if timed else 0.0, records[i].station, records[i].image),
    )
    rows = [records[i] for i in chosen]
    firsts: dict[int, ImageRecord] = {}
    for row in rows:
        firsts.setdefault(row.station, row)
    stations, first = list(firsts), list(firsts.values())
    number = {station: k for k, station in enumerate(stations)}
    moment = np.array([number[r.station] for r in rows])
    readings = readings[chosen]
    shared = np.full((len(stations), 6), np.nan)  # pictures of a station share what one has
    for at, row_of in zip(moment[::-1], readings[::-1], strict=True):
        shared[at] = np.where(np.isnan(row_of), shared[at], row_of)
    readings = np.where(np.isnan(readings), shared[moment], readings)
    unknown = RigidTransform.identity()
    levers = [unknown if body_from_cam is None else body_from_cam[r.camera] for r in rows]
    poses = RigidTransform.concatenate([model_from_cam[i] for i in chosen])
    mounts = RigidTransform.concatenate(levers)
    return Epochs(
        time=np.array([r.time_s for r in first] if timed else stations, np.float64),
        timed=timed,
        moment=moment,
        centres=poses.translation,
        model_from_body=poses.rotation * mounts.rotation.inv(),
        levers=-mounts.translation,
        measured_ned=_positions(readings, datum),
        ned_from_body=rotation_from_attitude(*np.deg2rad(np.nan_to_num(readings[:, 3:])).T),
        sigma=stated_sigmas(first),
        known=np.isfinite(shared),
        modes=np.zeros((len(chosen), 6, 0)) if modes is None else modes[chosen],
    )


def _readings(record: ImageRecord) -> Array:
    """(6,) what each channel of navigation says of a picture; NaN where it says nothing."""
    place = np.array([record.latitude_deg, record.longitude_deg])
    place = place + 0.0 * place.sum()  # one without the other is of no use
    attitude = record.roll_deg, record.pitch_deg, record.heading_deg
    return np.array([*place, record.depth_m, *attitude])


def _positions(readings: Array, datum: Datum | None) -> Array:
    """(N, 3) positions in NED; what is not known of one is that of the middle of all, else zero."""
    known = [bool(np.isfinite(column).any()) for column in readings[:, :3].T]
    if datum is None or not known[0]:
        depths = readings[:, 2]
        depths = np.where(np.isfinite(depths), depths, np.nanmean(depths) if known[2] else 0.0)
        return np.outer(depths, [0.0, 0.0, 1.0])
    places = readings[:, :3].copy()
    if not known[2]:
        places[:, 2] = 0.0
    middle = np.nanmean(places, axis=0)
    return datum.ned_from_geodetic(np.where(np.isfinite(places), places, middle))


def stated_sigmas(rows: Sequence[ImageRecord]) -> Array:
    """(N, 6) sigmas of the channels, metres and radians; usual ones where none are stated."""
    stated = np.array(
        [
            (r.sigma_horizontal_m, r.sigma_depth_m, r.sigma_attitude_deg, r.sigma_heading_deg)
            for r in rows
        ]
    )
    level, depth, *angles = np.where(stated > 0, stated, _USUAL_SIGMAS).T
    tilt, heading = np.deg2rad(angles)
    return np.stack([level, level, depth, tilt, tilt, heading], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class NavigationEquations:
    """Six channels at M times, linear about a placement: misfit + jacobian x change = error."""

    misfit: Array
    """(M, 6) model minus navigation, over the stated sigma; NaN where nothing is known."""
    jacobian: Array
    """(M, 6, PARAMETERS + K) its slopes."""
    sigma: Array
    """(M, 6) as stated."""


def equations(epochs: Epochs, place: Similarity, middle_ned: Array) -> NavigationEquations:
    """Misfits of navigation at a placement, and their derivatives.

    Args:
        epochs: navigation and model.
        place: present `ned_from_model`.
        middle_ned: (3,) about which the placement's rotation and scale change.
    """
    count = len(epochs.centres)
    positions = epochs.positions(place)
    attitudes = place.rotation * epochs.model_from_body
    columns = PARAMETERS + epochs.modes.shape[2]
    misfit, jacobian = np.empty((count, 6)), np.zeros((count, 6, columns))
    misfit[:, :3] = positions - epochs.measured_ned
    jacobian[:, :3, :3] = -cross_matrices(positions - middle_ned)
    jacobian[:, :3, 3:6] = np.eye(3)
    jacobian[:, :3, SCALE] = place.apply(epochs.centres) - middle_ned
    # A turn and a stretch of navigation's own frame move what it measures: the misfit loses them.
    away = positions - positions.mean(axis=0)
    jacobian[:, :2, STRETCH] = -away[:, :2]
    jacobian[:, 0, TURN], jacobian[:, 1, TURN] = away[:, 1], -away[:, 0]
    # Angle by angle: an error of heading must not count as one of roll where the vehicle leans, nor
    # a wrong heading spoil the tilt that was read with it.
    stated, found = (r.as_euler("ZYX")[:, ::-1] for r in (epochs.ned_from_body, attitudes))
    misfit[:, 3:] = (found - stated + np.pi) % (2.0 * np.pi) - np.pi
    angles_from_ned = np.linalg.pinv(attitude_axes(attitudes))
    jacobian[:, 3:, :3] = angles_from_ned
    ned_from_body = attitudes.as_matrix()
    jacobian[:, 3:, MOUNT] = angles_from_ned @ ned_from_body
    jacobian[:, :3, LEVER] = ned_from_body
    jacobian[:, :3, CLOCK] = _velocities(epochs, positions)
    elapsed = epochs.time - epochs.time[0]  # over that of all, from -1/2 to 1/2
    jacobian[:, 2, DRIFT] = (elapsed / max(float(elapsed[-1]), 1e-300) - 0.5)[epochs.moment]
    turn = place.rotation.as_matrix()
    turned = turn @ epochs.modes[:, 3:]
    moved = place.scale * turn @ epochs.modes[:, :3]
    arms = attitudes.apply(epochs.levers)
    jacobian[:, :3, PARAMETERS:] = moved - cross_matrices(arms) @ turned
    jacobian[:, 3:, PARAMETERS:] = angles_from_ned @ turned
    moments = len(epochs.time)
    shared = np.bincount(epochs.moment, minlength=moments).astype(np.float64)
    mean_misfit, mean_jacobian = np.zeros((moments, 6)), np.zeros((moments, 6, columns))
    np.add.at(mean_misfit, epochs.moment, misfit)
    np.add.at(mean_jacobian, epochs.moment, jacobian)
    scale = epochs.sigma * shared[:, None]
    return NavigationEquations(
        misfit=np.where(epochs.known, mean_misfit / scale, np.nan),
        jacobian=np.where(epochs.known[..., None], mean_jacobian / scale[..., None], np.nan),
        sigma=epochs.sigma,
    )


def _velocities(epochs: Epochs, positions: Array) -> Array:
    """Velocities of the pictures' bodies, (N, 3) m/s; 0 where times or neighbours are unknown.

    The mean of the differences to both neighbours in time, where these are near: lines end. An
    attitude changes too fast for its rates to be known from one station to the next.
    """
    found = np.zeros((len(epochs.time), 3))
    if epochs.timed and len(found) > 1:
        _, first = np.unique(epochs.moment, return_index=True)  # a picture of every moment
        step = np.diff(epochs.time)
        near = (step > 0) & (step < _NEAR_STEPS * np.median(step))
        between = np.where(near, np.diff(positions[first], axis=0).T / np.where(near, step, 1), 0).T
        known = np.zeros(len(found))
        for part in (slice(None, -1), slice(1, None)):
            found[part] += between
            known[part] += near
        found /= np.maximum(known, 1)[:, None]
    return found[epochs.moment]


_FEW_SIGMAS = 4.0
_LOG_SPREAD = 1.64
"""Sigma of the logarithm of a ratio of two median deviations, times the root of their number."""


def scatter_of_times(epochs: Epochs, place: Similarity, known_s: float) -> tuple[float, float]:
    """Sigma of single times against navigation's, and its own; 0 where it is not above `known_s`.

    Navigation's errors change slowly, and alike in all directions; those of a time act along the
    way only. Of three readings, the middle one minus what the others say of its time shows both.
    """
    first = np.unique(epochs.moment, return_index=True)[1]
    at, known = epochs.positions(place), epochs.known[:, 0]
    off, way = (at - epochs.measured_ned)[first, :2], _velocities(epochs, at)[first, :2][1:-1]
    square = (way**2).sum(axis=1)
    used = known[2:] & known[1:-1] & known[:-2] & (square > 0)
    if not used.any():
        return 0.0, 0.0
    spread = _LOG_SPREAD / float(np.sqrt(used.sum()))
    step = np.maximum(np.diff(epochs.time), 1e-9)[:, None]
    bend = off[1:-1] - (step[1:] * off[:-2] + step[:-1] * off[2:]) / (step[1:] + step[:-1])
    seconds = np.stack([bend * way, bend[:, ::-1] * way * [1.0, -1.0]]).sum(axis=2)
    along, across = MAD_TO_SIGMA * np.median(np.abs(seconds[:, used]) / square[used], axis=1)
    clear = along > across * np.exp(_FEW_SIGMAS * spread)
    found = float(np.sqrt(max(along**2 - across**2, 0.0) / 1.5))
    return (found, found * spread / math.sqrt(2.0)) if clear and found > known_s else (0.0, 0.0)


def with_times_unsure(epochs: Epochs, place: Similarity, sigma_s: float) -> Epochs:
    """The same with sigmas that tell of times of such sigma, where readings change fast."""
    first = np.unique(epochs.moment, return_index=True)[1]
    turns = (place.rotation * epochs.model_from_body[first]).as_euler("ZYX")[:, ::-1]
    change = np.abs(np.diff(np.column_stack([epochs.positions(place)[first], turns]), axis=0))
    change[:, 3:] = np.minimum(change[:, 3:], 2.0 * np.pi - change[:, 3:])
    rates = np.pad(change / np.maximum(np.diff(epochs.time), 1e-9)[:, None], ((1, 1), (0, 0)))
    fastest = np.maximum(rates[1:], rates[:-1])
    return replace(epochs, sigma=np.hypot(epochs.sigma, sigma_s * fastest))


def slopes_by_place(away: Array) -> Array:
    """(N, 3, 7) slopes of places (N, 3) about the middle by the placement."""
    slopes = np.zeros((len(away), 3, PLACE))
    slopes[:, :, :3] = -cross_matrices(away)
    slopes[:, :, 3:6] = np.eye(3)
    slopes[:, :, SCALE] = away
    return slopes


def attitude_axes(ned_from_body: Rotation) -> Array:
    """(N, 3, 3) matrices whose columns are the axes, in NED, of roll, pitch and heading.

    A small change of the angles (z-y-x) turns the body by the rotation vector `axes @ change`.
    """
    heading, pitch = ned_from_body.as_euler("ZYX")[:, :2].T
    zero, one = np.zeros(len(heading)), np.ones(len(heading))
    forward = np.stack(
        [np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), -np.sin(pitch)], axis=1
    )
    starboard = np.stack([-np.sin(heading), np.cos(heading), zero], axis=1)
    down = np.stack([zero, zero, one], axis=1)
    return np.stack([forward, starboard, down], axis=2)


_MIN_SPREAD = 0.1
"""Positions that spread less than this share of their sigma do not place a model."""
_RELIEF_SIGMAS = 3.0
"""Relief of a track over the sigma of its depths from which depths alone give the scale."""


def observable(epochs: Epochs) -> list[int]:
    """Parameters of rotation and shift that some reading depends on.

    Without positions north and east are the model's own, without headings too its heading; without
    depths its depth is the sea floor's, and where headings are all that is known, its level too: by
    choice, and so without a sigma.
    """
    free = [0, 1] if epochs.known[:, :5].any() else []
    if epochs.has_horizontal or epochs.known[:, 5].any():
        free.append(2)
    if epochs.has_horizontal:
        free += [3, 4]
    if epochs.known[:, 2].any():
        free.append(5)
    return free


def first_placement(
    epochs: Epochs, levelled: Similarity, known_scale: float | None
) -> Similarity | None:
    """A first placement: from attitudes, else from the levelled model and what is known.

    Args:
        epochs: navigation and model.
        levelled: the model on its mean plane.
        known_scale: metres in a unit of the model, or None.

    Returns:
        The placement; None, after a warning, where navigation gives no scale or place.
    """
    scale, turn = known_scale, 0.0
    angles = np.where(epochs.known, 0.0, np.nan)[epochs.moment, 3:].sum(axis=1)
    has = np.isfinite(angles)
    if epochs.has_horizontal:
        at = epochs.known[epochs.moment, 0]
        count = int(epochs.known[:, 0].sum())
        measured = epochs.measured_ned[at]
        spread = float(np.sqrt(measured[:, :2].var(axis=0).sum()))
        need = float(np.median(epochs.sigma[epochs.known[:, 0], 0]))
        flat = levelled.apply(epochs.centres)[at]
        if not has.any() or known_scale is None:
            minimum = 2 if has.any() else 3
            if count < minimum or spread <= _MIN_SPREAD * need:
                warn(
                    f"{count} positions spread over {spread:.2f} m at a sigma of {need:.2f} m do "
                    "not place the model: it stays without CRS"
                )
                return None
        a = (flat[:, :2] - flat[:, :2].mean(axis=0)) @ [1.0, 1j]
        b = (measured[:, :2] - measured[:, :2].mean(axis=0)) @ [1.0, 1j]
        spin = complex(np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-300))
        scale, turn = abs(spin) if scale is None else scale, float(np.angle(spin))
    else:
        scale = _scale_by_relief(epochs, levelled) if scale is None else scale
        if scale is None:
            return None
        headed = epochs.known[epochs.moment, 5]
        if headed.any() and not has.any():
            stated = epochs.ned_from_body[headed].as_euler("ZYX")[:, 0]
            found = (levelled.rotation * epochs.model_from_body[headed]).as_euler("ZYX")[:, 0]
            turn = float(np.angle(np.exp(1j * (stated - found)).mean()))
    rotation = Rotation.from_rotvec([0.0, 0.0, turn]) * levelled.rotation
    if has.any():
        some = np.flatnonzero(has)
        rotation = (epochs.ned_from_body[some] * epochs.model_from_body[some].inv()).mean()
    return _shift(epochs, levelled, scale, rotation)


def _scale_by_relief(epochs: Epochs, levelled: Similarity) -> float | None:
    """The scale by which the relief of the track fits its depths, where they hold it.

    Depth is linear in the model's coordinates, and a slope of the track against the level is one of
    the model's tilt: what is left after slopes is the scale's.
    """
    at = epochs.known[epochs.moment, 2]
    if not at.any():
        warn("navigation gives no scale to a model without one: it stays unscaled, without CRS")
        return None
    flat, depths = levelled.apply(epochs.centres)[at], epochs.measured_ned[at, 2]
    sigma = float(np.median(epochs.sigma[epochs.known[:, 2], 2]))
    slopes = np.column_stack([np.ones(len(flat)), flat[:, :2]])
    relief, rest = (v - slopes @ np.linalg.lstsq(slopes, v)[0] for v in (flat[:, 2], depths))
    along = float(relief @ rest) / max(float(relief @ relief), 1e-300)
    size = along * float(np.sqrt(np.mean(relief**2)))
    if len(np.unique(epochs.moment[at])) <= slopes.shape[1] or size < _RELIEF_SIGMAS * sigma:
        warn(
            f"depths along the track show {max(size, 0.0):.2f} m of the model's relief at a sigma "
            f"of {sigma:.2f} m, too little for its scale: it stays unscaled, without CRS; measure "
            "a known length with 'alice-survey control'"
        )
        return None
    # The depth's gradient in the model has the length of the scale; the slopes are its other part.
    tilt = np.linalg.lstsq(slopes, depths - along * flat[:, 2])[0][1:]
    return float(np.sqrt(along**2 + tilt @ tilt))


def _shift(epochs: Epochs, levelled: Similarity, scale: float, rotation: Rotation) -> Similarity:
    """A placement shifted onto the readings, else with the origin of the levelled model."""
    start = Similarity(scale=scale, rotation=rotation, translation=np.zeros(3))
    origin = -levelled.rotation.inv().apply(levelled.translation) / levelled.scale
    shift = -scale * rotation.apply(origin)
    off = epochs.measured_ned - epochs.positions(start)
    for axis in range(3):
        known = epochs.known[epochs.moment, axis]
        if known.any():
            shift[axis] = np.median(off[known, axis])
    return Similarity(scale=scale, rotation=rotation, translation=shift)
