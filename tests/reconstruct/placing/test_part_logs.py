"""Logs without positions, from the import to the placed model, against the truth."""

import csv
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from alice_survey.core.config import load_config
from alice_survey.core.executor import SERIAL
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import FrameRecord, GeoreferenceRecord, RegistrationRecord
from alice_survey.core.stages import spec
from reconstruct.evaluate.truth import read_true_poses
from reconstruct.pictures.importing import import_images
from reconstruct.placing.track import read_track_poses
from tests.docs.given_files import SAID, photos, rows_of

pytestmark = pytest.mark.slow
CAMERAS = ("left", "right")


@pytest.mark.parametrize("columns", [("depth_m",), ("depth_m", "heading_deg")])
def test_a_log_without_positions_places_a_rigs_model_as_far_as_it_goes(
    small_survey: Path, tmp_path: Path, columns: tuple[str, ...]
) -> None:
    names = [*columns, *(f"sigma_{name}" for name in columns)]
    with (tmp_path / "log.csv").open("w", newline="") as file:
        log = csv.writer(file)
        log.writerow(["time_utc", *names])
        for row in rows_of(small_survey / "flight" / "navigation.csv")[::10]:
            when = SAID + timedelta(seconds=float(row["time_s"]))
            log.writerow([when.isoformat(), *(row[name] for name in names)])
    records = read_manifest(small_survey / "images" / "manifest.csv")
    stations = sorted({record.station for record in records})
    for camera in CAMERAS:
        photos(small_survey, tmp_path / camera, stations, camera=camera)
    workspace = tmp_path / "dive"
    done = import_images(
        workspace, [], cameras={name: tmp_path / name for name in CAMERAS},
        navigation=tmp_path / "log.csv", rig=small_survey / "calibration" / "rig.json",
    )  # fmt: skip
    assert (done.positions, done.readings["depth"]) == (0, 2 * len(stations))
    config = load_config(small_survey / "survey.toml")
    for stage in ("mapping", "placing"):
        assert spec(stage).make(workspace, config, SERIAL)

    sparse = workspace / "sparse"
    frame = FrameRecord.read(sparse / "frame.json")
    assert (frame.name, frame.datum, frame.scaled) == ("model", None, True)
    assert frame.vertical_datum == "sea surface, as in the navigation log"
    assert RegistrationRecord.read(sparse / "registration.json").registered == 2 * len(stations)
    fit = GeoreferenceRecord.read(sparse / "georeference.json")
    assert fit.sigma_north_m is None and fit.sigma_depth_m is not None
    assert fit.sigma_tilt_deg is not None

    found, true = (
        [poses[name] for name in sorted(poses)]
        for poses in (
            read_track_poses(sparse / "track.csv"),
            read_true_poses(small_survey / "images" / "truth" / "poses.csv"),
        )
    )
    off = found[0].rotation * true[0].rotation.inv()
    down = off.apply([0.0, 0.0, 1.0])
    lean_deg = np.rad2deg(np.hypot(down[0], down[1]))
    assert lean_deg < 3.0 * fit.sigma_tilt_deg < 6.0
    sunk_m = np.mean(
        [a.translation[2] - b.translation[2] for a, b in zip(found, true, strict=True)]
    )
    assert abs(sunk_m) < 3.0 * fit.sigma_depth_m < 0.5
    turn_deg = abs(off.as_euler("ZYX", degrees=True)[0])
    if "heading_deg" in columns:
        assert fit.sigma_heading_deg is not None
        assert turn_deg < 3.0 * fit.sigma_heading_deg < 10.0
    else:
        assert fit.sigma_heading_deg is None
