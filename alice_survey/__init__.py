"""Plan, fly, image, reconstruct and score close-range underwater imaging surveys.

The names below are the public Python interface; everything else may change without notice. They
are imported when first used, so that `import alice_survey` is quick:

    >>> import alice_survey as alice
    >>> config = alice.SurveyConfig()
    >>> camera = alice.design_rig(config.camera, config.water).cameras["left"]
    >>> camera.project([0.1, 0.0, 2.0]).round(1)
    array([1918.6, 1355. ])
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from alice_survey.app.api.arrays import Dem, Mosaic, Track, read_dem, read_mosaic, read_track
    from alice_survey.app.api.figures import plot_dem, plot_mosaic, plot_plan, plot_track
    from alice_survey.app.api.survey import Survey, call
    from alice_survey.core.config import SurveyConfig, load_config
    from alice_survey.core.errors import AliceError
    from alice_survey.core.frames import Datum
    from alice_survey.core.seawater import n_water
    from camera_calib.camera import Camera
    from camera_calib.lenses.fisheye import FisheyeLens
    from camera_calib.lenses.opencv import OpenCVLens
    from camera_calib.ports.dome import DomePort
    from camera_calib.ports.flat import FlatPort
    from camera_calib.rig import Covariance, Rig, design_rig, read_rig, write_rig
    from camera_calib.triangulate import Triangulation, triangulate
    from missions.values.plan_file import Plan, read_plan
    from reconstruct.views.model import SparseModel, View, read_model

_HOMES = {
    "alice_survey.app.api.figures": ("plot_dem", "plot_mosaic", "plot_plan", "plot_track"),
    "alice_survey.app.api.arrays": (
        "Dem", "Mosaic", "Track", "read_dem", "read_mosaic", "read_track",
    ),
    "alice_survey.app.api.survey": ("Survey", "call"),
    "alice_survey.core.config": ("SurveyConfig", "load_config"),
    "alice_survey.core.errors": ("AliceError",),
    "alice_survey.core.frames": ("Datum",),
    "alice_survey.core.seawater": ("n_water",),
    "camera_calib.camera": ("Camera",),
    "camera_calib.lenses.fisheye": ("FisheyeLens",),
    "camera_calib.lenses.opencv": ("OpenCVLens",),
    "camera_calib.ports.dome": ("DomePort",),
    "camera_calib.ports.flat": ("FlatPort",),
    "camera_calib.rig": ("Covariance", "Rig", "design_rig", "read_rig", "write_rig"),
    "camera_calib.triangulate": ("Triangulation", "triangulate"),
    "missions.values.plan_file": ("Plan", "read_plan"),
    "reconstruct.views.model": ("SparseModel", "View", "read_model"),
}  # fmt: skip

__all__ = [
    "AliceError", "Camera", "Covariance", "Datum", "Dem", "DomePort", "FisheyeLens", "FlatPort",
    "Mosaic", "OpenCVLens", "Plan", "Rig", "SparseModel", "Survey", "SurveyConfig", "Track",
    "Triangulation", "View", "call", "design_rig", "load_config", "n_water", "plot_dem",
    "plot_mosaic", "plot_plan", "plot_track", "read_dem", "read_model", "read_mosaic",
    "read_plan", "read_rig", "read_track", "triangulate", "write_rig",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(home), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
