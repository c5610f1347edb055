"""The stage that calibrates from a pool."""

from pathlib import Path

import numpy as np
import pytest

from alice_survey.app.stages import spec
from alice_survey.core.config import CameraConfig, ImagingConfig, SurveyConfig
from alice_survey.core.executor import SERIAL
from camera_calib.rig import read_rig

DOME = CameraConfig(
    port="dome", dome_radius_m=0.08, dome_centre_m=(0.0, 0.0, 0.005), glass_thickness_m=0.006,
    n_glass=1.49,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_a_dome_is_calibrated_in_air_and_in_the_pool(lens: str, tmp_path: Path) -> None:
    camera = DOME.model_copy(update={"lens": lens})
    config = SurveyConfig(camera=camera, imaging=ImagingConfig(scale=6, pool_views=10))
    for stage in ("pool", "calibrate"):
        assert spec(stage).make(tmp_path, config, SERIAL)
    found = read_rig(tmp_path / "calibration" / "rig.json")
    truth = read_rig(tmp_path / "pool" / "truth" / "rig.json")
    off = []
    for name, camera_found in found.cameras.items():
        for field in ("fx_px", "cx_px", "dome_x_m", "dome_y_m", "dome_z_m"):
            miss = camera_found.parameter(field) - truth.cameras[name].parameter(field)
            off.append(miss / found.sigmas[f"{name}.{field}"])
        assert found.sigmas[f"{name}.dome_z_m"] < 2e-4
    assert np.sqrt(np.mean(np.square(off))) < 2.0
