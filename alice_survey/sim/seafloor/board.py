"""A chessboard in a pool, seen through the ports: pictures to calibrate the rig from."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.compiled import compiled
from alice_survey.core.errors import CalibrationError
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from alice_survey.sim.seafloor.renderer import camera_rays, ray_bands
from alice_survey.sim.seafloor.texture import noise
from camera_calib.camera import Camera
from camera_calib.rig import Rig

Floats = NDArray[np.float32]

NEAREST_M, MAX_M = 0.7, 2.0
STEEPEST_RAD = math.radians(35.0)
_WHITE, _BLACK, _TILE = 0.75, 0.04, 0.30
_WALL_M = 3.5
"""The pool's wall, square to the axis of the camera."""
_TRIES = 600


@dataclass(frozen=True, kw_only=True)
class PoolBoard:
    """A flat chessboard with a white margin of one square.

    Its frame has the origin at the first inner corner, x along columns, y along rows of corners and
    z into the board, away from the camera.
    """

    columns: int = 11
    rows: int = 8
    """Inner corners along x and along y."""
    square_m: float = 0.04

    @property
    def corners(self) -> Array:
        """(rows * columns, 3) inner corners, row by row, metres."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * self.square_m

    @property
    def outline(self) -> Array:
        """(4, 3) outer corners of the chessboard without its margin, metres."""
        right, bottom = self.columns * self.square_m, self.rows * self.square_m
        low = -self.square_m
        return np.array([[low, low, 0], [right, low, 0], [right, bottom, 0], [low, bottom, 0]])


@progress.step("place the board")
def pool_poses(
    board: PoolBoard, rig: Rig, views: int, rng: np.random.Generator
) -> list[RigidTransform]:
    """Poses of the board before the rig, `rig_from_board`: near and far, tilted every way.

    The place aimed at goes over a grid of three by three parts of the frame, so that corners fall
    everywhere; the whole chessboard is in the frame of every camera.

    Args:
        board: the board.
        rig: the cameras; the first camera's frame is the rig's.
        views: number of poses.
        rng: source of the poses.

    Raises:
        CalibrationError: the board does not fit into both frames at the distances there are.
    """
    return [_pool_pose(board, rig, view, views, rng) for view in range(views)]


def _pool_pose(
    board: PoolBoard, rig: Rig, view: int, views: int, rng: np.random.Generator
) -> RigidTransform:
    # The places aimed at are in the pictures of all cameras in turn.
    name = list(rig.cameras)[view % len(rig.cameras)]
    camera, rig_from_cam = rig.cameras[name], rig.cam_from_rig[name].inv()
    frame, centre = np.array([camera.width_px, camera.height_px]), board.outline.mean(axis=0)
    for attempt in range(_TRIES):
        # As near as the board fits at the place aimed at, or up to twice as far; later tries draw
        # back, and towards the middle.
        ease = attempt / _TRIES
        near = NEAREST_M + ease * (MAX_M - NEAREST_M)
        distance_m = 1.0 / rng.uniform(1.0 / min(2.0 * near, MAX_M), 1.0 / near)
        tilt = STEEPEST_RAD * math.sqrt(rng.uniform(0.05, 1.0)) * (1.0 - 0.5 * ease)
        towards = 2.399963 * view + rng.uniform(-0.5, 0.5)
        spin = rng.uniform(-0.5, 0.5) + (math.pi / 2.0 if view % 4 == 3 else 0.0)
        cell = np.array([view % 3, (view // 3) % 3]) + rng.uniform(0.0, 1.0, 2)
        pixel = frame * (0.5 + (cell / 3.0 - 0.5) * (1.0 - 0.5 * ease))
        lean = Rotation.from_rotvec([tilt * math.cos(towards), tilt * math.sin(towards), 0.0])
        turn = lean * Rotation.from_rotvec([0.0, 0.0, spin])
        place = camera.at_depth(pixel, distance_m) - turn.apply(centre)
        rig_from_board = rig_from_cam * RigidTransform.from_components(place, turn)
        if all(_in_frame(board, rig, other, rig_from_board) for other in rig.cameras):
            return rig_from_board
    raise CalibrationError(
        f"pool view {view + 1} of {views}: a board of {board.columns} x {board.rows} corners of "
        f"{board.square_m * 1e3:.0f} mm fits into no picture of both cameras between {NEAREST_M} "
        f"and {MAX_M} m: check focal_mm and baseline_m"
    )


def _in_frame(board: PoolBoard, rig: Rig, name: str, rig_from_board: RigidTransform) -> bool:
    camera = rig.cameras[name]
    pixels = camera.project((rig.cam_from_rig[name] * rig_from_board).apply(board.outline))
    margin = 0.01 * camera.width_px
    limits = np.array([camera.width_px, camera.height_px]) - margin
    return bool(np.all((pixels > margin) & (pixels < limits)))


def render_board(
    board: PoolBoard, camera: Camera, cam_from_board: RigidTransform, samples: int
) -> Floats:
    """Reflected light of the board in front of a tiled wall, evenly lit, with the lens's fall-off.

    Args:
        board: the board.
        camera: the camera.
        cam_from_board: pose of the board.
        samples: rays along a side of a pixel.

    Returns:
        (H, W, 3) red, green and blue as shares of the light on it.
    """
    board_from_cam = cam_from_board.inv()
    rotation, place = board_from_cam.rotation.as_matrix(), board_from_cam.translation
    picture = np.empty((camera.height_px, camera.width_px, 3), dtype=np.float32)
    light = _uneven_light(camera)
    for first, last in ray_bands(camera, samples):
        rays = camera_rays(camera, samples, first, last)
        _shade_board(
            rays.origins, rays.directions, rays.vignetting, rotation, place, board.square_m,
            board.columns, board.rows, samples, light[first:last], picture[first:last],
        )  # fmt: skip
    return picture


def _uneven_light(camera: Camera) -> Floats:
    """Uneven light, a few percent over the frame, (H, W)."""
    y, x = np.mgrid[: camera.height_px, : camera.width_px] / camera.width_px
    total = np.zeros(x.size, dtype=np.float32)
    for lattice in (0.7, 0.3):
        part = np.empty(x.size, dtype=np.float32)
        noise(x.ravel(), y.ravel(), np.zeros(x.size), lattice, np.uint32(99), part)
        total += np.float32(0.04) * part
    return total.reshape(x.shape)


@compiled
def _shade_board(
    origins: Array,
    directions: Array,
    vignetting: Array,
    rotation: Array,
    place: Array,
    square_m: float,
    columns: int,
    rows: int,
    samples: int,
    light: Array,
    picture: Array,
) -> None:
    count = samples * samples
    width = picture.shape[1]
    for pixel in range(picture.shape[0] * width):
        row, column = pixel // width, pixel % width
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(count):
            i = pixel * count + k
            px, py, pz = place
            dx, dy, dz = 0.0, 0.0, 0.0
            for a in range(3):
                px += rotation[0, a] * origins[i, a]
                py += rotation[1, a] * origins[i, a]
                pz += rotation[2, a] * origins[i, a]
                dx += rotation[0, a] * directions[i, a]
                dy += rotation[1, a] * directions[i, a]
                dz += rotation[2, a] * directions[i, a]
            reach = -pz / dz if dz > 0.0 else -1.0
            u, v = (px + reach * dx) / square_m + 1.0, (py + reach * dy) / square_m + 1.0
            on_board = -1.0 <= u <= columns + 2.0 and -1.0 <= v <= rows + 2.0
            if reach > 0.0 and on_board:
                inside = 0.0 <= u < columns + 1.0 and 0.0 <= v < rows + 1.0
                dark = inside and (math.floor(u) + math.floor(v)) % 2 == 0
                shade = vignetting[i] * (_BLACK if dark else _WHITE)
                red, green, blue = red + 0.97 * shade, green + shade, blue + 0.98 * shade
            else:
                away = (_WALL_M - origins[i, 2]) / directions[i, 2]
                x = (origins[i, 0] + away * directions[i, 0]) / 0.15
                y = (origins[i, 1] + away * directions[i, 1]) / 0.15
                joint = min(abs(x - math.floor(x + 0.5)), abs(y - math.floor(y + 0.5))) < 0.02
                shade = vignetting[i] * _TILE * (0.9 if joint else 1.0)
                red, green, blue = red + 0.55 * shade, green + 0.95 * shade, blue + shade
        level = (1.0 + light[row, column]) / count
        picture[row, column, 0] = red * level
        picture[row, column, 1] = green * level
        picture[row, column, 2] = blue * level


def board_records(rig: Rig, poses: Sequence[RigidTransform]) -> list[dict[str, RigidTransform]]:
    """`cam_from_board` of every camera, view by view."""
    return [{name: rig.cam_from_rig[name] * pose for name in rig.cameras} for pose in poses]
