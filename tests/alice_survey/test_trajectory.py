from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from alice_survey.core.errors import NavigationError
from alice_survey.core.frames import rotation_from_attitude
from alice_survey.core.trajectory import (
    TRACK_COLUMNS,
    Trajectory,
    read_columns,
    read_track,
    write_track,
)
from tests.refusals import refused


def track(count: int = 50, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    rotation = rotation_from_attitude(*rng.uniform([-1, -1, -3], [1, 1, 3], (count, 3)).T)
    places = rng.uniform(-1000, 1000, (count, 3))
    return Trajectory(
        time_s=np.cumsum(rng.uniform(0.01, 1.0, count)),
        ned_from_body=RigidTransform.from_components(places, rotation),
    )


@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 1000))
def test_a_track_comes_back_from_its_file(
    seed: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("track") / "track.csv"
    before = track(seed=seed)
    write_track(path, before)
    after = read_track(path)

    np.testing.assert_allclose(after.time_s, before.time_s, atol=1e-9)
    np.testing.assert_allclose(
        after.ned_from_body.as_matrix(), before.ned_from_body.as_matrix(), atol=2e-9
    )


def test_a_track_file_is_plain_columns(tmp_path: Path) -> None:
    poses = RigidTransform.from_components(
        [[1.0, 2.0, 3.0]],
        rotation_from_attitude(np.deg2rad([1.0]), np.deg2rad(2.0), np.deg2rad(-3.0)),
    )
    write_track(tmp_path / "t.csv", Trajectory(time_s=np.array([0.5]), ned_from_body=poses))
    lines = (tmp_path / "t.csv").read_text().splitlines()

    assert lines[0] == ",".join(TRACK_COLUMNS)
    values = [float(cell) for cell in lines[1].split(",")]
    np.testing.assert_allclose(values, [0.5, 1, 2, 3, 1, 2, -3], atol=1e-9)


def test_times_must_increase_and_fit_the_poses() -> None:
    poses = track(3).ned_from_body
    for time_s in ([0.0, 1.0, 1.0], [0.0, 1.0]):
        with pytest.raises(ValueError):
            Trajectory(time_s=np.array(time_s), ned_from_body=poses)


def test_columns_may_come_in_any_order_and_company(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("﻿b,note,a\n2,x,1\n4,y,3e0\n", encoding="utf-8")

    columns = read_columns(path, ("a", "b"))

    assert columns["a"].tolist() == [1.0, 3.0]
    assert columns["b"].tolist() == [2.0, 4.0]
    path.write_text("a,b\n")
    assert read_columns(path, ("a", "b"))["b"].shape == (0,)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("a\n1\n", "column b"), ("", "empty"), ("a,b\n1,2\n3,nan\n", "line 3: b is 'nan'"),
        ("a,b\n1,inf\n", "line 2: b is 'inf'"), ("a,b\n1,\n", "line 2: b is ''"),
        ("a,b\n1\n", "line 2: b is ''"), ("a,b\nten,1\n", "line 2: a is 'ten'"),
    ],
)  # fmt: skip
def test_a_fault_is_reported_with_its_line(tmp_path: Path, content: str, named: str) -> None:
    path = tmp_path / "log.csv"
    path.write_text(content)
    with refused(NavigationError, named, path):
        read_columns(path, ("a", "b"))


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "bin.csv").write_bytes(b"\xff\xfe\x80")
    for path in (tmp_path / "none.csv", tmp_path / "bin.csv"):
        with refused(NavigationError, path):
            read_columns(path, ("a",))


@pytest.mark.parametrize(
    ("rows", "named"),
    [("0,0,0,0,0,0,0\n0,0,0,0,0,0,0\n", "line 3: time_s"), ("", ""), ("1" * 200_000, "")],
    ids=["times repeat", "no rows", "a cell without end"],
)
def test_a_wrong_track_is_refused(tmp_path: Path, rows: str, named: str) -> None:
    path = tmp_path / "track.csv"
    path.write_text(",".join(TRACK_COLUMNS) + "\n" + rows)
    with refused(NavigationError, path, named):
        read_track(path)
