"""The stages of a survey, in one list: run, status, report, view and documentation read it.

A stage is added by adding a `StageSpec`. Nothing here imports the packages that do the work: each
is named as `module:function` and loaded when its stage is made, so that `status` compares digests
without them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from alice_survey.core import artefacts, records
from alice_survey.core.artefacts import Stage, read_json, read_stage, run_stage, why_stale
from alice_survey.core.config import VEHICLE_FILES, Config, SurveyConfig
from alice_survey.core.errors import AliceError, WorkspaceError
from alice_survey.core.executor import Executor
from alice_survey.core.manifest import read_manifest
from alice_survey.kit.words import share

Summary = tuple[str, dict[str, Any]]
"""Result of a stage: a line of text, and JSON values."""
StageWork = Callable[..., None]
"""Takes the workspace, the folder to write into and where tasks run; the settings by keyword."""
WHOLE = "survey"
"""Names all settings at once in `StageSpec.takes`."""

LOOSE_FOLDERS = ("quality", "reference", "against")
"""Folders that commands write next to those of the stages, and that a report shows."""
CONTROL_FILES = ("control.csv", "picks.csv", "markers.csv")
SCALE_FILE = "scale.json"
COLOUR_FILE = "colour_reference.csv"


@dataclass(frozen=True, kw_only=True)
class StageSpec:
    """One step of a survey: its dependencies, its implementation and its output."""

    name: str
    """Name, also of its package and its command, where it has its own."""
    folder: str
    """The folder of the workspace that it writes."""
    command: str
    """The command that makes it."""
    about: str
    version: int
    """Increase it when the stage's code changes its result; `tests/test_stage_code.py` checks."""
    work: str
    """`module:function` of a `StageWork`."""
    summary: Callable[[Path], Summary]
    """Takes the stage's folder."""
    takes: Sequence[str] = ()
    """Dotted names of the settings that the work takes, each by the last part of its name."""
    needs: Sequence[str] = ()
    """Stages that it requires."""
    uses: Sequence[str] = ()
    """Stages that it uses if they exist."""
    settings: "Mapping[str, Any] | SettingsPart" = field(default_factory=dict)
    """All settings that the result depends on, as `settings_of` reads them."""
    setting_files: Sequence[str] = ()
    """Dotted names of the settings that are files, or lists of files."""
    inputs: Callable[[Path], Sequence[Path]] = lambda workspace: ()
    """All files of a workspace that the result depends on."""
    resumes: bool = False
    """Work resumes from what an interrupted run of the same digest left."""
    simulated: bool = False
    """It is for simulated surveys: imported pictures have no such stage."""
    products: Mapping[str, str] = field(default_factory=dict)
    """Its products for users: paths below its folder, and descriptions."""
    picture: str = ""
    """A product to look at first."""
    reported: Sequence[str] = ()
    """Files that a report reads: paths below its folder, `.` for all of it."""

    def stage(self, workspace: Path, config: SurveyConfig) -> Stage:
        """Dependencies of the stage, in a workspace."""
        return Stage(
            name=self.folder,
            version=self.version,
            settings=settings_of(self.settings, config),
            inputs=[*self.inputs(workspace), *files_of(self.setting_files, config)],
            resumes=self.resumes,
        )

    def make(self, workspace: Path, config: SurveyConfig, executor: Executor) -> bool:
        """Run the stage unless it is up to date.

        Returns:
            True when done, False when nothing had changed.

        Raises:
            WorkspaceError: a stage that it needs is missing.
        """
        for name in self.needs:
            need(workspace, name)
        module, function = self.work.split(":")
        taken = {
            name.rpartition(".")[2]: config if name == WHOLE else attrgetter(name)(config)
            for name in self.takes
        }

        def work(folder: Path) -> None:
            do: StageWork = getattr(import_module(module), function)
            with executor.started() as started:
                do(workspace, folder, started, **taken)

        return run_stage(workspace, self.stage(workspace, config), work)

    def state(self, workspace: Path, config: SurveyConfig, before: Mapping[str, str]) -> str:
        """Whether the stage is up to date, or why it is not.

        Args:
            workspace: folder of the survey.
            config: its settings.
            before: states of earlier stages, by name.
        """
        record = read_stage(workspace / self.folder)
        if record is None:
            partial = workspace / f"{self.folder}.partial"
            return "interrupted" if partial.exists() else "missing"
        if "refly_of" in record.settings or (self.name == "image" and is_imported(workspace)):
            return "up to date"  # it was made by another command, from other settings
        for name in (*self.needs, *self.uses):
            state = before.get(name, "up to date")
            if state != "up to date" and not (name in self.uses and state == "missing"):
                return f"stale ({name} is {state.split()[0]})"
        try:
            why = why_stale(workspace, self.stage(workspace, config))
        except AliceError as error:
            why = str(error)
        return "up to date" if why is None else f"stale ({why})"


@dataclass(frozen=True, kw_only=True)
class SettingsPart:
    """Some values of a section of the settings."""

    section: str
    only: frozenset[str] | None = None
    without: frozenset[str] = frozenset()


def only(section: str, *names: str) -> SettingsPart:
    """The values of some names."""
    return SettingsPart(section=section, only=frozenset(names))


def without(section: str, *names: str) -> SettingsPart:
    """The values of all other names."""
    return SettingsPart(section=section, without=frozenset(names))


def settings_of(wanted: Any, config: Config) -> Any:
    """Settings as JSON values: what a stage's digest is made of.

    Args:
        wanted: a `SettingsPart`; the dotted name of a value or a section; a mapping of these; or
            a value that stands for itself.
        config: the settings of a survey.

    Returns:
        Values in the form that `wanted` has; files by their names alone, so that a survey may be
        moved.
    """
    if isinstance(wanted, Mapping):
        return {key: settings_of(value, config) for key, value in wanted.items()}
    if not isinstance(wanted, str | SettingsPart):
        return wanted
    part = SettingsPart(section=wanted) if isinstance(wanted, str) else wanted
    value = attrgetter(part.section)(config)
    if not isinstance(value, BaseModel):
        return list(value) if isinstance(value, tuple) else value
    values = value.model_dump(
        mode="json",
        include=None if part.only is None else set(part.only),
        exclude=set(part.without),
    )
    kept = {}
    if isinstance(value, Config):
        left_out = part.without | value.unrecorded
        kept = {
            name: constant
            for name, constant in value.constants.items()
            if name not in left_out and (part.only is None or name in part.only)
        }
    return kept | {name: _file_name(getattr(value, name), values[name]) for name in values}


def _file_name(value: Any, as_json: Any) -> Any:
    """A file's name, of a path or of text that names a vehicle's file; other values as JSON."""
    is_file = isinstance(value, str) and value.lower().endswith(VEHICLE_FILES)
    return Path(value).name if is_file or isinstance(value, Path) else as_json


def files_of(wanted: Sequence[str], config: Config) -> list[Path]:
    """The files that settings name; none for those that are not set."""
    values = [attrgetter(name)(config) for name in wanted]
    return [path for value in values for path in (value if isinstance(value, list) else [value])
            if path is not None]  # fmt: skip


def spec(name: str) -> StageSpec:
    """The stage of a name, or of a folder.

    Raises:
        WorkspaceError: there is none.
    """
    for stage in STAGES:
        if name in (stage.name, stage.folder):
            return stage
    raise WorkspaceError(f"there is no stage {name!r}: the stages are {', '.join(names())}")


def names(*commands: str) -> list[str]:
    """Names of the stages that some commands run, in order; of all stages without one."""
    return [stage.name for stage in STAGES if not commands or stage.command in commands]


def need(workspace: Path, name: str) -> Path:
    """The folder of a finished stage.

    Raises:
        WorkspaceError: it is not there; the message names the command that makes it.
    """
    stage = spec(name)
    command = "import-images" if name == "image" and not _is_planned(workspace) else stage.command
    return artefacts.need_stage(workspace, stage.folder, command)


def finished(workspace: Path) -> dict[str, artefacts.StageRecord]:
    """Records of all finished stages, by their folders."""
    found = {stage.folder: read_stage(workspace / stage.folder) for stage in STAGES}
    return {folder: record for folder, record in found.items() if record is not None}


def is_imported(workspace: Path) -> bool:
    """Whether the pictures of a workspace are real ones."""
    pictures = records.PicturesRecord.made(workspace / "images" / "survey.json")
    return pictures is not None and pictures.source == "imported"


def table() -> str:
    """All stages as a Markdown table, for the documentation."""
    rows = [
        f"| `{stage.name}` | `{stage.folder}/` | `{stage.command}` | {stage.about} | "
        f"{', '.join(f'`{name}`' for name in stage.needs)} | "
        f"{'; '.join(f'`{path}` ({what})' for path, what in stage.products.items())} |"
        for stage in STAGES
    ]
    head = "| stage | folder | made by | what it does | needs | products |"
    return "\n".join([head, "|---|---|---|---|---|---|", *rows])


def _is_planned(workspace: Path) -> bool:
    return (workspace / "survey.toml").is_file() or (workspace / "plan").is_dir()


def _there(*paths: Path | None) -> list[Path]:
    return [path for path in paths if path is not None and path.is_file()]


def _given(*paths: Path | None) -> list[Path]:
    return [path for path in paths if path is not None]


def _plan_summary(folder: Path) -> Summary:
    plan = read_json(folder / "plan.json")
    dives = len(plan["dives"])
    text = (
        f"{len(plan['lines'])} lines, {plan['stations']} stations, {plan['length_m']:.0f} m, "
        f"{plan['duration_s'] / 60:.0f} min, {plan['energy_wh']:.0f} Wh in {dives} "
        f"dive{'s' if dives > 1 else ''}; overlap {plan['forward_overlap']:.0%} forward, "
        f"{plan['side_overlap']:.0%} side, {share(plan['coverage'])} covered as requested; "
        f"a picture every {plan['interval_s']:.2f} s, exposed {1e3 * plan['exposure_s']:.2g} ms; "
        f"map in {folder / 'map.png'}, files for vehicles in {folder / 'exports'}"
    )
    return text, plan


def _fly_summary(folder: Path) -> Summary:
    flight = records.FlightRecord.read(folder / "flight.json")
    line = flight.on_lines
    mission = flight.mission
    how = flight.controller if mission is None else f"{mission.file} as {mission.follower} flies it"
    promised = (
        ""
        if mission is None
        else f" (the plan's certificate: {share(mission.planned.share_at_overlap)}; "
        f"{mission.line_ends_overshot} of {mission.line_ends} line ends overshot)"
    )
    text = (
        f"{flight.vehicle} with {how}: {flight.ending}, {flight.stations} of "
        f"{flight.stations_planned} stations in {flight.duration_s / 60:.0f} min; on lines "
        f"{_metres(line.cross_track_rms_m)} cross-track rms (the control's part "
        f"{_metres(line.believed_cross_track_rms_m)}), heading {_degrees(line.heading_rms_deg)} "
        f"rms; roll in turns to {_degrees(flight.in_turns.roll_worst_deg)}; "
        f"{sum(flight.energy_wh.values()):.1f} Wh; "
        f"{share(flight.coverage.share_at_overlap)} of the area covered as requested{promised}, "
        f"{share(flight.coverage.every_camera_share)} seen by every camera; "
        f"plots in {folder / 'track.png'} and {folder / 'vehicle.png'}"
    )
    return text, flight.to_json()


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f} deg"


def _image_inputs(workspace: Path) -> list[Path]:
    flight = workspace / "flight"
    return [
        workspace / "plan" / "plan.json",
        flight / "triggers.csv",
        flight / "navigation.csv",
        flight / "truth" / "track.csv",
    ]


def _pictures_summary(folder: Path) -> Summary:
    count = len(read_manifest(folder / "manifest.csv"))
    return f"{count} pictures in {folder}", {"pictures": count}


def _calibrate_inputs(workspace: Path) -> list[Path]:
    pool = workspace / "pool"
    air = [pool / "air"] if (pool / "air").exists() else []
    return [pool / name for name in ("manifest.csv", "board.json", "left", "right")] + air


def _calibrate_summary(folder: Path) -> Summary:
    found = records.CalibrationRecord.read(folder / "calibration.json")
    text = (
        f"{found.views} views, {found.rms_px:.3f} px rms; rig in {folder / 'rig.json'}, "
        f"report in {folder / 'report.html'}"
    )
    return text, {"views": found.views, "rms_px": found.rms_px, "worst_px": found.worst_px}


def rig_file(workspace: Path) -> Path | None:
    """The rig of a survey's pictures: as calibrated, else as imported with them; None without."""
    folders = ("calibration", "images")
    return next(iter(_there(*(workspace / folder / "rig.json" for folder in folders))), None)


def _about_pictures(workspace: Path) -> list[Path]:
    """Files that say what the pictures are."""
    images = workspace / "images"
    return [images / "manifest.csv", images / "survey.json", *_given(rig_file(workspace))]


def _mapping_inputs(workspace: Path) -> list[Path]:
    images = workspace / "images"
    rows = read_manifest(images / "manifest.csv")
    files = [*(row.image for row in rows), *(row.mask for row in rows if row.mask)]
    return [*_about_pictures(workspace), *(images / file for file in files)]


def _mapping_summary(folder: Path) -> Summary:
    found = records.MappingRecord.read(folder / "mapping.json")
    text = f"{found.registered} of {found.total} pictures in the model, in its own gauge"
    return text, {"registered": found.registered, "total": found.total}


def _placing_inputs(workspace: Path) -> list[Path]:
    known = _there(*(workspace / name for name in (SCALE_FILE, *CONTROL_FILES)))
    return [workspace / "mapping", *_about_pictures(workspace), *known]


def _placing_summary(folder: Path) -> Summary:
    found = records.RegistrationRecord.read(folder / "registration.json")
    text = (
        f"{found.registered} of {found.total} pictures registered, "
        f"{found.mean_reprojection_px:.2f} px; {found.scale_source}"
    )
    if found.joints:
        text += f"; {len(found.joints) + 1} parts that navigation alone joins, to " + " and ".join(
            f"{math.hypot(joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m):.2g} m"
            for joint in found.joints
        )
    if found.georeference is not None and found.georeference.mount is not None:
        text += f"; {found.georeference.mount.words}"
    return text, found.to_json()


def _model_inputs(workspace: Path) -> list[Path]:
    """The placed model, and the pictures and masks that are in it."""
    sparse, images = workspace / "sparse", workspace / "images"
    pictures = records.CamerasRecord.read(sparse / "cameras.json").images
    files = [*pictures, *(picture.mask for picture in pictures.values() if picture.mask)]
    return [sparse, *(images / file for file in files)]


def _dense_inputs(workspace: Path) -> list[Path]:
    return _model_inputs(workspace)


def _dense_summary(folder: Path) -> Summary:
    found = records.CloudRecord.read(folder / "cloud.json")
    surfaces = [folder / "dem.tif", *sorted(folder.glob("planes/*/dem.tif"))]
    text = f"{found.points} points; surface in {', '.join(str(path) for path in surfaces)}"
    return text, found.to_json()


def _mosaic_inputs(workspace: Path) -> list[Path]:
    dense = workspace / "dense"
    planes = sorted((dense / "planes").glob("*/dem.tif"))
    about = _there(*(path.with_name("plane.json") for path in (dense / "dem.tif", *planes)))
    about += _there(dense / "moving.csv", workspace / COLOUR_FILE)
    cloud = [dense / name for name in ("cloud.ply", "cloud.json")]
    return [dense / "dem.tif", *planes, *cloud, *about, *_model_inputs(workspace)]


def _mosaic_summary(folder: Path) -> Summary:
    texts, values = [], []
    for path in _there(folder / "mosaic.json", *sorted(folder.glob("planes/*/mosaic.json"))):
        found = records.MosaicRecord.read(path)
        texts.append(f"{found.width_px} x {found.height_px} px in {path.with_suffix('.tif')}")
        values.append(found.to_json())
    return "; ".join(texts), values[0] if values else {}


def _mesh_inputs(workspace: Path) -> list[Path]:
    dense = [workspace / "dense" / name for name in ("cloud.ply", "cloud.json", "light.json")]
    return [*dense, *_there(workspace / "dense" / "moving.csv"), *_model_inputs(workspace)]


def _mesh_summary(folder: Path) -> Summary:
    found = records.MeshRecord.read(folder / "mesh.json")
    text = (
        f"{found.triangles} triangles, {found.textured_share:.0%} textured, in "
        f"{folder / 'mesh.glb'}"
    )
    return text, found.to_json()


def _evaluate_inputs(workspace: Path) -> list[Path]:
    images, mesh = workspace / "images", workspace / "mesh"
    if not (images / "truth").is_dir():
        raise WorkspaceError(
            f"{images} has no truth: only simulated surveys can be scored; what is known of this "
            f"one is in {workspace / 'sparse' / 'registration.json'}"
        )
    read = [
        "images/truth/poses.csv", "images/truth/terrain.ply", "images/truth/rig.json",
        "dense/dem.tif", "dense/sigma.tif", "mosaic/mosaic.tif", "sparse/track.csv",
        "sparse/registration.json", "plan/plan.json", "images/manifest.csv", "flight/triggers.csv",
    ]  # fmt: skip
    if read_stage(mesh) is not None:
        read += ["mesh/mesh.ply", "mesh/mesh.json"]
    return [workspace / path for path in read]


def _evaluate_summary(folder: Path) -> Summary:
    score = records.ScoreRecord.read(folder / "score.json").to_json()
    rows = [
        (f"{group}.{name}", value)
        for group, part in score.items()
        for name, value in (part or {}).items()
    ]
    table = "\n".join(f"  {name:44} {value}" for name, value in rows)
    return f"score in {folder / 'score.json'}\n{table}", score


def _report_inputs(workspace: Path) -> list[Path]:
    if not finished(workspace):
        raise WorkspaceError(
            f"{workspace} holds nothing to report on: run 'alice-survey plan' or 'import-images'"
        )
    read = [workspace / "survey.toml"]
    read += [workspace / stage.folder / path for stage in STAGES for path in stage.reported]
    read += [f for name in LOOSE_FOLDERS for f in sorted((workspace / name).rglob("*.json"))]
    read += sorted((workspace / "quality").glob("*.csv"))
    return [path for path in read if path.exists()]


def _report_summary(folder: Path) -> Summary:
    found = records.ReportRecord.read(folder / "report.json")
    answers = "\n".join(f"  {question}: {text}" for question, text in found.summary.items())
    return f"{folder / 'report.html'} and {folder / 'report.pdf'}\n{answers}", found.to_json()


STAGES: tuple[StageSpec, ...] = (
    StageSpec(
        name="plan",
        folder="plan",
        command="plan",
        about="lines, stations and camera settings that image the area",
        version=7,
        work="missions.plan.run:run_plan",
        takes=(WHOLE,),
        settings={
            "name": "name",
            "area": "area",
            "camera": "camera",
            "water": without("water", "n_water_sigma"),
            "plan": "plan",
            "sea": "sea",
            "vehicle": without("vehicle", "dive", "mission_file"),
            "datum_given": "area.datum_given",
            "strobes": only("imaging", "strobe_lumens", "strobe_beam_deg", "strobes_body_m"),
        },
        setting_files=(
            "area.files",
            "area.bathymetry_file",
            "sea.current_file",
            "vehicle.coefficients_file",
            "vehicle.file",
        ),
        summary=_plan_summary,
        simulated=True,
        products={
            "plan.json": "the plan, for the next stages",
            "settings.txt": "every setting with its equation, source and limit",
            "exports": "the plan for vehicles",
        },
        picture="map.png",
        reported=("plan.json",),
    ),
    StageSpec(
        name="fly",
        folder="flight",
        command="fly",
        about="the plan flown by a simulated vehicle",
        version=5,
        work="missions.fly.run:run_fly",
        takes=(WHOLE,),
        needs=("plan",),
        settings={
            "seed": "seed",
            "vehicle": without("vehicle", "coefficients_file", "mission_file"),
            "sea": without("sea", "current_file"),
            "navigation": "navigation",
            "seafloor": "seafloor",
            "seafloor_depth_m": "area.seafloor_depth_m",
            "plan": "plan",
            "position_body_m": "camera.position_body_m",
            "dvl_position_body_m": "camera.dvl_position_body_m",
        },
        setting_files=(
            "sea.current_file",
            "vehicle.coefficients_file",
            "vehicle.file",
            "vehicle.mission_file",
        ),
        inputs=lambda workspace: [workspace / "plan" / "plan.json"],
        summary=_fly_summary,
        simulated=True,
        products={
            "triggers.csv": "when pictures are taken",
            "navigation.csv": "where the vehicle believed to be",
            "vehicle.csv": "log of the vehicle",
            "bag": "the same as a ROS 2 bag",
        },
        picture="track.png",
        reported=("flight.json",),
    ),
    StageSpec(
        name="pool",
        folder="pool",
        command="image",
        about="rendered pictures of a board, to calibrate from",
        version=4,
        work="missions.acquire.run:run_pool",
        takes=("camera", "water", "imaging", "seed"),
        settings={
            "seed": "seed",
            "camera": "camera",
            "n_water": "water.n_water",
            "board": records.BoardRecord().to_json(),
            "imaging": only("imaging", "scale", "image_format", "samples", "noise", "pool_views"),
        },
        summary=_pictures_summary,
        resumes=True,
        simulated=True,
        products={"manifest.csv": "the pictures", "board.json": "the board"},
        picture="left/00.png",
    ),
    StageSpec(
        name="image",
        folder="images",
        command="image",
        about="the pictures: rendered, or real ones (`import-images`)",
        version=5,
        work="missions.acquire.run:run_images",
        takes=(
            "camera",
            "water",
            "imaging",
            "seafloor",
            "plan.altitude_m",
            "area.seafloor_depth_m",
            "seed",
        ),
        needs=("plan", "fly"),
        settings={
            "seed": "seed",
            "seafloor_depth_m": "area.seafloor_depth_m",
            "margins": only("plan", "altitude_m", "run_in_m", "turn_radius_m", "margin_m"),
            "camera": "camera",
            "water": without("water", "n_water_sigma"),
            "seafloor": "seafloor",
            "imaging": without("imaging", "pool_views"),
        },
        inputs=_image_inputs,
        summary=_pictures_summary,
        resumes=True,
        simulated=True,
        products={"manifest.csv": "the pictures, with time and navigation"},
        picture="left/000000.png",
        reported=("manifest.csv",),
    ),
    StageSpec(
        name="calibrate",
        folder="calibration",
        command="calibrate",
        about="the rig, from the pictures of the board",
        version=5,
        work="camera_calib.calibrate.run:run_calibrate",
        takes=("camera", "water"),
        needs=("pool",),
        settings={"camera": "camera", "water": without("water", "n_water_sigma")},
        inputs=_calibrate_inputs,
        summary=_calibrate_summary,
        simulated=True,
        products={
            "rig.json": "cameras, ports and baseline with their covariance",
            "report.html": "how good the calibration is",
        },
        reported=("report.json",),
    ),
    StageSpec(
        name="mapping",
        folder="mapping",
        command="reconstruct",
        about="cameras and points in the model's own gauge",
        version=13,
        work="reconstruct.mapping.run:run_mapping",
        takes=("reconstruct", "seed"),
        needs=("image",),
        uses=("calibrate",),
        settings={
            "seed": "seed",
            "feature_scale": None,
            "max_features": "reconstruct.max_features",
            "learned_features": "reconstruct.learned_features",
            "working_range_m": None,
            "mapper": "reconstruct.mapper",
        },
        inputs=_mapping_inputs,
        summary=_mapping_summary,
        resumes=True,
        reported=("mapping.json",),
    ),
    StageSpec(
        name="placing",
        folder="sparse",
        command="reconstruct",
        about="the model placed in the world",
        version=17,
        work="reconstruct.placing.run:run_sparse",
        takes=("reconstruct", "water.index_sigma"),
        needs=("image", "mapping"),
        uses=("calibrate",),
        settings={
            "reconstruct": only(
                "reconstruct",
                "mount_sigma_deg",
                "lever_sigma_m",
                "clock_sigma_s",
                "refine_port",
                "refine_rig",
            ),
            "index_sigma": "water.index_sigma",
        },
        inputs=_placing_inputs,
        summary=_placing_summary,
        products={"track.csv": "camera track with sigmas", "model": "COLMAP model"},
        reported=(".",),
    ),
    StageSpec(
        name="dense",
        folder="dense",
        command="reconstruct",
        about="the surface: depth of every view, fused",
        version=13,
        work="reconstruct.dense.run:run_dense",
        takes=("reconstruct",),
        needs=("image", "placing"),
        settings=only(
            "reconstruct", "dense_scale", "dense_partners", "dem_cell_m", "planes", "mask_moving"
        ),
        inputs=_dense_inputs,
        summary=_dense_summary,
        resumes=True,
        products={
            "dem.tif": "elevation model (GeoTIFF)",
            "sigma.tif": "sigma of its heights",
            "planes": "the same over further planes",
            "cloud.copc.laz": "point cloud (COPC) with colour, normal, sigma",
            "moving": "masks of what moves",
        },
        picture="dem.png",
        reported=("dem.tif", "sigma.tif", "plane.json", "planes", "moving.png"),
    ),
    StageSpec(
        name="mosaic",
        folder="mosaic",
        command="reconstruct",
        about="the orthomosaic, painted on the surface",
        version=11,
        work="reconstruct.mosaic.run:run_mosaic",
        takes=("reconstruct", "water", "area.seafloor_depth_m"),
        needs=("image", "placing", "dense"),
        settings={
            "mosaic_pixel_m": "reconstruct.mosaic_pixel_m",
            "colour": "reconstruct.colour",
            "dispersion": "reconstruct.dispersion",
            "water": without("water", "n_water_sigma"),
        },
        inputs=_mosaic_inputs,
        summary=_mosaic_summary,
        products={
            "mosaic.tif": "orthomosaic (cloud-optimised GeoTIFF)",
            "planes": "those of further planes",
            "footprints.geojson": "what each picture shows",
        },
        picture="mosaic.png",
        reported=("mosaic.tif", "planes"),
    ),
    StageSpec(
        name="mesh",
        folder="mesh",
        command="reconstruct",
        about="the textured mesh",
        version=4,
        work="reconstruct.mesh.run:run_mesh",
        takes=("reconstruct",),
        needs=("image", "placing", "dense"),
        settings=only(
            "reconstruct", "mesh_triangles", "mesh_error_px", "mesh_page_px", "mesh_tiles"
        ),
        inputs=_mesh_inputs,
        summary=_mesh_summary,
        products={
            "mesh.glb": "textured mesh",
            "tiles/tileset.json": "the same in full detail as 3D Tiles, where it is large",
        },
        picture="mesh.png",
        reported=("mesh.glb",),
    ),
    StageSpec(
        name="evaluate",
        folder="evaluation",
        command="evaluate",
        about="errors against the truth of the simulation",
        version=4,
        work="reconstruct.evaluate.run:run_evaluate",
        takes=("seed",),
        needs=("image", "placing", "dense", "mosaic", "plan"),
        uses=("mesh",),
        settings={"seed": "seed"},
        inputs=_evaluate_inputs,
        summary=_evaluate_summary,
        simulated=True,
        products={"score.json": "errors against the truth"},
        picture="errors.png",
        reported=(".",),
    ),
    StageSpec(
        name="report",
        folder="report",
        command="report",
        about="a page and a PDF of what the workspace holds",
        version=10,
        work="alice_survey.app.report.run:run_report",
        uses=("mosaic", "mesh", "evaluate"),
        inputs=_report_inputs,
        summary=_report_summary,
        products={
            "report.html": "one page that needs no network",
            "report.pdf": "the same to print",
        },
    ),
)
"""All stages, in the order in which they run."""
