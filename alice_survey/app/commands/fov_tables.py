"""The `fov` command: what a lens sees, and the check of the paper's optics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import json_values, write_csv
from alice_survey.core.config import CameraConfig, SurveyConfig, load_config, parse_config
from alice_survey.core.errors import ConfigError, warn
from camera_calib.formats.rigs import led_by
from camera_calib.fov.display import (
    draw_fov,
    fov_csv_rows,
    fov_text,
    validation_rows,
    validation_text,
)
from camera_calib.fov.paper import paper_settings, validate_paper
from camera_calib.fov.table import FovRow, blur_table, fov_table, rig_fov_table
from camera_calib.rig import Rig, port_settings, read_rig

PAPER_LENSES_MM = (12.5, 25.0)
PAPER_EXPOSURE_MS = 3.0


@dataclass(frozen=True, kw_only=True)
class FovOptions:
    """Options of `fov`; None or empty is the survey's, or else the paper's."""

    lens_mm: Sequence[float] = ()
    altitude_m: Sequence[float] = ()
    speed_mps: Sequence[float] = ()
    exposure_ms: Sequence[float] = ()
    survey: Path | None = None
    rig: Path | None = None
    rig_camera: str | None = None
    n_water: float | None = None
    csv: Path | None = None
    plot: Path | None = None
    """Files to write the rows and draw the curves to."""


def fov_report(options: FovOptions) -> tuple[str, Any]:
    """FOV, resolution, focus, stereo and blur as text and JSON values."""
    settings = _settings(options)
    rig = _rig(options, settings.water.n_water)
    camera, n_water = settings.camera, settings.water.n_water
    if rig is not None:
        camera, n_water = _sensor_of(rig, settings.camera)
    lenses = options.lens_mm or ((camera.focal_mm,) if options.survey else PAPER_LENSES_MM)

    def table(altitudes_m: Sequence[float]) -> list[FovRow]:
        if rig is not None:
            return rig_fov_table(rig, altitudes_m, camera)
        return fov_table(lenses, altitudes_m, n_water, camera)

    altitudes = options.altitude_m or (settings.plan.altitude_m,)
    speeds = options.speed_mps or (settings.plan.speed_mps,)
    exposures = [ms * 1e-3 for ms in options.exposure_ms or (PAPER_EXPOSURE_MS,)]
    allowed = settings.plan.allowed_blur_px
    rows = table(altitudes)
    blur = blur_table(rows, speeds, exposures, allowed)
    if options.csv is not None:
        _write(options.csv, fov_csv_rows(rows, blur))
    if options.plot is not None:
        draw_fov(options.plot, table, altitudes)
    data = {
        "source": "design values" if rig is None else rig.source,
        "rows": json_values(rows),
        "blur": json_values(blur),
    }
    return fov_text(rows, blur), data


def validation_report(options: FovOptions) -> tuple[str, Any]:
    """The paper's claims on optics, with `passed`: whether every check that has a rule does.

    Raises:
        ConfigError: an option was given: the claims bring their own lenses, water and altitude.
    """
    if options != FovOptions(csv=options.csv, plot=options.plot):
        raise ConfigError(
            "--validate checks the paper's own lenses, water and altitude: leave out all options "
            "but --plot, --csv and --json"
        )
    validation = validate_paper()
    if options.csv is not None:
        _write(options.csv, validation_rows(validation))
    if options.plot is not None:
        camera, n_water, altitude = paper_settings()
        draw_fov(
            options.plot,
            lambda heights: fov_table(PAPER_LENSES_MM, heights, n_water, camera),
            [altitude],
        )
    return validation_text(validation), validation.to_json()


def _settings(options: FovOptions) -> SurveyConfig:
    """The survey's settings, overridden by the command line."""
    survey = SurveyConfig() if options.survey is None else load_config(options.survey)
    if options.n_water is None:
        return survey
    water = {"jerlov": survey.water.jerlov, "n_water": options.n_water}
    return parse_config(survey.model_dump(mode="json") | {"water": water}, "options")


def _rig(options: FovOptions, n_water: float) -> Rig | None:
    if options.rig is None:
        if options.rig_camera is not None:
            raise ConfigError("--camera names a camera of a rig: give --rig too")
        return None
    if options.lens_mm:
        raise ConfigError(f"{options.rig} has lenses of its own: leave out --lens")
    rig = read_rig(options.rig)
    if options.rig_camera is not None:
        rig = led_by(rig, options.rig_camera)
    elif len(rig.cameras) > 2:
        first, *others = rig.cameras
        warn(f"of the rig's cameras, this is {first}; --camera shows {', '.join(others)}")
    return rig if options.n_water is None else rig.in_water(n_water)


def _sensor_of(rig: Rig, camera: CameraConfig) -> tuple[CameraConfig, float]:
    """Sensor and port of a rig's reference camera, and its water; a rig has no pixel pitch."""
    own = rig.cameras[rig.reference]
    pixel_um = camera.pixel_um
    if own.width_px != camera.width_px:
        pixel_um *= camera.width_px / own.width_px
        warn(
            f"the rig's pictures are {own.width_px} px wide and the settings' "
            f"{camera.width_px}: pixels of {pixel_um:.4g} um (the same sensor) are taken for the "
            "depth of field; pixel_um under [camera] of --survey sets it"
        )
    update = {
        "width_px": own.width_px,
        "height_px": own.height_px,
        "pixel_um": pixel_um,
        **port_settings(own),
    }
    return camera.model_copy(update=update), own.n_water


def _write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    try:
        write_csv(path, list(rows[0]), [list(row.values()) for row in rows])
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from None
