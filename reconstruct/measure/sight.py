"""From where the mosaic shows a spot: an error of height moves the spot along that ray."""

import json
from pathlib import Path

import numpy as np
from rasterio.windows import Window

from alice_survey.core.artefacts import read_csv
from alice_survey.core.contents import taken_from
from alice_survey.core.frames import Array
from reconstruct.planes import Plane
from reconstruct.raster import opened_raster, small_cache

SOURCE = "mosaic/mosaic_source.tif"
_TRACK = "sparse/track.csv"
_AXES = (("north_m", "east_m", "depth_m"), ("x_m", "y_m", "z_m"), ("x", "y", "z"))


def sight_lines(workspace: Path, plane: Plane, points: Array) -> Array | None:
    """How far a spot of the mosaic moves aside for each unit that its height is too large.

    The picture that painted it sees the spot along one ray; where the surface is too high the ray
    meets it earlier, nearer to the camera.

    Args:
        workspace: reconstructed.
        plane: of its rasters.
        points: (N, 3) right, up and out on the surface.

    Returns:
        (N, 2) right and up; 0 where no picture painted the spot; None without a mosaic.
    """
    source, track = workspace / SOURCE, workspace / _TRACK
    if not source.is_file() or not track.is_file():
        return None
    numbers = np.zeros(len(points), np.int64)
    with small_cache(), opened_raster(source) as raster:
        names = json.loads(raster.tags().get("PICTURES", "[]"))
        for n, (x, y, _) in enumerate(points):
            row, column = raster.index(x, y)
            if 0 <= row < raster.height and 0 <= column < raster.width:
                numbers[n] = raster.read(1, window=Window(int(column), int(row), 1, 1))[0, 0]
    wanted = {names[n - 1] for n in numbers.tolist() if 0 < n <= len(names)}
    centres = camera_centres(track, plane, wanted)
    lines = np.zeros((len(points), 2))
    for n, point in enumerate(points):
        if 0 < numbers[n] <= len(names) and names[numbers[n] - 1] in centres:
            arm = centres[names[numbers[n] - 1]] - point
            lines[n] = arm[:2] / arm[2] if arm[2] > 0 else 0.0
    return lines


def camera_centres(track: Path, plane: Plane, wanted: set[str]) -> dict[str, Array]:
    """Centres (3,) of cameras, right, up and out, by picture."""
    header, rows = read_csv(track)
    axes = next((axes for axes in _AXES if axes[0] in header), _AXES[0])
    with taken_from(track):
        places = {
            row["image"]: np.array([float(row[axis]) for axis in axes])
            for _, row in rows
            if row["image"] in wanted
        }
    centres = {}
    for name, place in places.items():
        up, right, into = plane.plane_from_world.apply(place)
        centres[name] = np.array([right, up, -into])
    return centres
