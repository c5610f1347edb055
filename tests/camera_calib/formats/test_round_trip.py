"""What a format is given comes back from it: random rigs, out and in again."""

import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings

from camera_calib.formats.convert import FORMATS, detect
from camera_calib.formats.rigs import ReadOptions, rename_cameras
from camera_calib.rig import Rig
from tests.strategies_formats import (
    BOTH_LENSES,
    EVERY,
    PLUMB_BOB,
    RADTAN,
    RATIONAL,
    assert_same_geometry,
    rigs,
)

QUICK = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])

BOTH: dict[str, Any] = {"lenses": BOTH_LENSES}
ALL: dict[str, Any] = {**BOTH, "ports": ("none", "flat", "dome")}
TARGETS = {
    "rig": ("rig", "rig.json", {"terms": EVERY, **ALL, "maximum": 3}),
    "opencv-yaml": ("opencv", "cameras.yml", {"terms": EVERY, **BOTH}),
    "opencv-xml": ("opencv", "cameras.xml", {"terms": EVERY, **BOTH}),
    "colmap-text": ("colmap", "model", {"terms": RATIONAL, **BOTH, "maximum": 3}),
    "colmap-binary": ("colmap", "model/cameras.bin", {"terms": RATIONAL, **BOTH, "maximum": 3}),
    "refractive-text": ("refractive", "model", {"terms": RATIONAL, **ALL, "maximum": 3}),
    "refractive-binary": ("refractive", "model/cameras.bin", {"terms": RATIONAL, **ALL}),
    "kalibr": ("kalibr", "camchain.yaml", {"terms": RADTAN, **BOTH, "maximum": 3}),
    "ros-rational": ("ros", "out.yaml", {"terms": RATIONAL, **BOTH, "maximum": 1}),
    "ros-plumb-bob": ("ros", "out.yaml", {"terms": PLUMB_BOB, "maximum": 1}),
    "metashape": ("metashape", "camera.xml", {"terms": PLUMB_BOB, **BOTH, "maximum": 1}),
}
SAME_FORMAT = {"refractive": ("refractive", "colmap")}
"""Without any port, the cameras of Refractive COLMAP are COLMAP's."""


@pytest.mark.parametrize("case", TARGETS)
def test_a_rig_comes_back_through_a_format_found_by_itself(case: str) -> None:
    kind, name, what = TARGETS[case]

    @QUICK
    @given(rig=rigs(**what))
    def comes_back(rig: Rig) -> None:
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / name
            FORMATS[kind].write(target, rig)
            assert detect(target).name in SAME_FORMAT.get(kind, (kind,))
            after = detect(target).read(target, ReadOptions())
        if kind == "metashape" and len(rig.cameras) == 1:
            after = rename_cameras(after, list(rig.cameras))  # the file holds no name
        assert_same_geometry(after, rig)

    comes_back()
