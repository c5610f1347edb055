"""What a format is given comes back from it: random rigs, out and in again."""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from camera_calib.formats.convert import FORMATS, Conversion, convert, detect
from camera_calib.formats.rigs import ReadOptions, rename_cameras
from camera_calib.rig import Rig, read_rig, write_rig
from tests.strategies_formats import (
    BOTH_LENSES,
    EVERY,
    PLUMB_BOB,
    RADTAN,
    RATIONAL,
    assert_same_geometry,
    covariance_of,
    rigs,
)

QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])

BOTH: dict[str, Any] = {"lenses": BOTH_LENSES}
ALL: dict[str, Any] = {**BOTH, "ports": ("none", "flat", "dome")}
TARGETS = {
    "rig": ("rig", "rig.json", {"terms": EVERY, **ALL, "maximum": 3}),
    "opencv-yaml": ("opencv", "cameras.yml", {"terms": EVERY, **ALL}),
    "opencv-xml": ("opencv", "cameras.xml", {"terms": EVERY, **ALL}),
    "colmap-text": ("colmap", "model", {"terms": RATIONAL, **BOTH, "maximum": 3}),
    "colmap-binary": ("colmap", "model/cameras.bin", {"terms": RATIONAL, **BOTH, "maximum": 3}),
    "refractive-text": ("refractive", "model", {"terms": RATIONAL, **ALL, "maximum": 3}),
    "refractive-binary": ("refractive", "model/cameras.bin", {"terms": RATIONAL, **ALL}),
    "kalibr": ("kalibr", "camchain.yaml", {"terms": RADTAN, **BOTH, "maximum": 3}),
    "ros-rational": ("ros", "out.yaml", {"terms": RATIONAL, **BOTH, "one_size": True}),
    "ros-plumb-bob": ("ros", "out.yaml", {"terms": PLUMB_BOB, "one_size": True}),
    "metashape": ("metashape", "camera.xml", {"terms": PLUMB_BOB, **BOTH, "maximum": 1}),
    "mrcal": ("mrcal", "out.cameramodel", {"terms": EVERY, "maximum": 3}),
}
SAME_FORMAT = {"refractive": ("refractive", "colmap")}
"""Without any port, the cameras of Refractive COLMAP are COLMAP's."""


def target_of(folder: Path, name: str, rig: Rig) -> Path:
    """Where formats have a file for each camera, that of several is a folder."""
    if name.startswith("out"):
        name = Path(name).stem if len(rig.cameras) > 1 else name
    return folder / name


@pytest.mark.parametrize("case", TARGETS)
def test_a_rig_comes_back_through_a_format_found_by_itself(case: str) -> None:
    kind, name, what = TARGETS[case]

    @QUICK
    @given(rig=rigs(**what))
    def comes_back(rig: Rig) -> None:
        with tempfile.TemporaryDirectory() as folder:
            target = target_of(Path(folder), name, rig)
            FORMATS[kind].write(target, rig)
            assert detect(target).name in SAME_FORMAT.get(kind, (kind,))
            after = detect(target).read(target, ReadOptions())
        if kind in ("metashape", "mrcal") and len(rig.cameras) == 1:
            after = rename_cameras(after, list(rig.cameras))  # the file holds no name
        assert_same_geometry(after, rig)

    comes_back()


@QUICK
@given(rig=rigs(ports=("flat",)), seed=st.integers(0, 1000))
def test_opencv_holds_all_that_a_rig_has(rig: Rig, seed: int) -> None:
    full = replace(rig, covariance=covariance_of(rig, np.random.default_rng(seed)))
    with tempfile.TemporaryDirectory() as folder:
        own, other, back = (Path(folder) / name for name in ("a.json", "b.xml", "c.json"))
        write_rig(own, full)
        convert(Conversion(source=own, target=other))
        convert(Conversion(source=other, target=back))
        after = read_rig(back)

    for name, camera in full.cameras.items():
        assert after.cameras[name].port.axis_cam == camera.port.axis_cam
        assert after.cameras[name].parameter("n_glass") == camera.parameter("n_glass")
        np.testing.assert_allclose(
            after.body_from_cam(name).as_matrix(), full.body_from_cam(name).as_matrix(), atol=1e-14
        )
    assert after.source == full.source
    assert full.covariance is not None
    assert after.covariance is not None
    assert after.covariance.parameters == full.covariance.parameters
    np.testing.assert_array_equal(after.covariance.matrix, full.covariance.matrix)
