"""Partners of pictures that look at walls, and round a pile, by what they truly share."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from alice_survey.core.manifest import ImageRecord
from camera_calib.rig import Rig
from reconstruct.matching import pairs
from tests.reconstruct.scenes import DATUM, make_scene

DISTANCE_M = 2.0
RANGE_M = (1.6, 2.5)


def forward_rig() -> Rig:
    """Of the scenes, looking ahead with the image's top up."""
    rig = make_scene(lines=1, stations=2, points=20).rig
    ahead = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return replace(
        rig, body_from_rig=RigidTransform.from_components([0, 0, 0], Rotation.from_matrix(ahead))
    )


def records_at(
    places_ned: Array, headings_deg: Array, cameras: Sequence[str] = ("left", "right")
) -> list[ImageRecord]:
    geodetic = DATUM.geodetic_from_ned(np.asarray(places_ned, dtype=np.float64))
    return [
        ImageRecord(
            image=f"{camera}/{i}.png", camera=camera, station=i, latitude_deg=float(place[0]),
            longitude_deg=float(place[1]), depth_m=float(place[2]), roll_deg=0.0, pitch_deg=0.0,
            heading_deg=float(heading) % 360.0,
        )
        for i, (place, heading) in enumerate(zip(geodetic, headings_deg, strict=True))
        for camera in cameras
    ]  # fmt: skip


def wall(columns: int, rows: int, step_m: float) -> list[ImageRecord]:
    """Rows of stations that look north at a wall, there and back."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    column = np.where(row % 2 == 0, column, columns - 1 - column)
    places = np.column_stack([0.0 * row, step_m * column, 10.0 + step_m * row])
    return records_at(places, np.zeros(len(row)))


def width_m(rig: Rig) -> tuple[float, float]:
    """Of what a picture shows of the wall, across and down, through the exact port."""
    camera = rig.cameras["left"]
    w, h = camera.width_px, camera.height_px
    ends = np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    start, way = camera.unproject(ends)
    hits = start + ((DISTANCE_M - start[:, 2]) / way[:, 2])[:, None] * way
    return float(hits[1, 0] - hits[0, 0]), float(hits[3, 1] - hits[2, 1])


def test_shares_are_those_of_the_wall() -> None:
    rig = forward_rig()
    wide, high = width_m(rig)
    right, down = 0.3 * wide, 0.4 * high
    places = [[0, 0, 10], [0, right, 10], [0, 0, 10 + down], [0, right, 10 + down]]
    records = records_at(np.array(places), np.zeros(4), ["left"])
    frusta = pairs.frusta_of(records, rig, DATUM, DISTANCE_M, DISTANCE_M * (1 + 1e-9))
    found = pairs.overlap_shares(frusta, [(0, 1), (0, 2), (0, 3)], np.zeros(4))
    # A lattice of six rays a side counts in sixths.
    for pair, expected in {(0, 1): 0.7, (0, 2): 0.6, (0, 3): 0.42}.items():
        assert found[pair][0] == pytest.approx(expected, abs=0.13)
        assert found[pair][1] >= found[pair][0]


def test_pictures_of_a_wall_are_paired_with_all_around_and_no_others() -> None:
    rig = forward_rig()
    wide, high = width_m(rig)
    step = 0.35 * min(wide, high)
    records = wall(12, 4, step)
    assert not pairs.placed_pictures(records, rig, DATUM)
    assert pairs.placed_pictures(records, rig, DATUM, RANGE_M) == set(range(len(records)))
    sure, maybe = pairs.choose_pairs(records, rig, DATUM, (), RANGE_M)
    places = DATUM.ned_from_geodetic(
        np.array([[r.latitude_deg, r.longitude_deg, r.depth_m] for r in records])
    )
    apart = np.abs(places[:, None, 1:] - places[None, :, 1:])
    overlap = (1 - apart[..., 0] / wide) * (1 - apart[..., 1] / high)
    linked = np.array(sorted(set(sure) - pairs.neighbours(records, 0)))
    assert all(records[i].camera == records[j].camera for i, j in linked.tolist())
    assert overlap[tuple(linked.T)].min() > 0.1
    cameras = np.array([r.camera for r in records])
    next_to = (apart.max(axis=2) > 0.5 * step) & (apart.max(axis=2) < 1.05 * step)
    next_to &= (apart.min(axis=2) < 0.05 * step) & (cameras[:, None] == cameras)
    near = {(i, j) for i, j in np.argwhere(np.triu(next_to)).tolist()}
    assert near <= set(sure) | set(maybe) and len(near) == 2 * (11 * 4 + 12 * 3)
    assert np.bincount(linked.ravel()).max() <= 40
    assert (0, len(records) - 1) not in set(sure) | set(maybe)


def test_opposite_sides_of_a_pile_are_no_partners() -> None:
    rig = forward_rig()
    angles = np.deg2rad(np.arange(0, 360, 15))
    places = np.column_stack([-2.3 * np.cos(angles), -2.3 * np.sin(angles), np.full(24, 8.0)])
    records = records_at(places, np.rad2deg(angles), ["left"])
    sure, maybe = pairs.choose_pairs(records, rig, DATUM, (), RANGE_M)
    apart = {
        pair: abs((pair[0] - pair[1] + 12) % 24 - 12) * 15
        for pair in itertools.combinations(range(24), 2)
    }
    assert {pair for pair, angle in apart.items() if angle == 15} <= set(sure)
    # Rays meet under 70 degrees at most; those of a frame are up to 25 degrees off its axis.
    assert all(apart[pair] <= 75 for pair in sure)
    assert all(apart[pair] <= 105 for pair in maybe)
