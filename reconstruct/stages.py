"""The stages from pictures to a model and its score: what each depends on, makes and says.

Nothing here imports the modules that do the work: they are named, and loaded when a stage is made.
"""

import json
import math
from collections.abc import Collection
from pathlib import Path

from alice_survey.core import records
from alice_survey.core.artefacts import content_token, read_csv, read_stage
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.manifest import read_manifest
from alice_survey.core.products import listed_in
from alice_survey.core.stages import StageSpec, Summary, only, without
from alice_survey.kit.words import count, figure_rows, text_table

CONTROL_FILES = ("control.csv", "picks.csv", "markers.csv")
SCALE_FILE = "scale.json"
COLOUR_FILE = "colour_reference.csv"


def _existing(*paths: Path) -> list[Path]:
    return [path for path in paths if path.is_file()]


def rig_file(workspace: Path) -> Path | None:
    """The rig of a survey's pictures: as calibrated, else as imported with them; None without."""
    folders = ("calibration", "images")
    return next(iter(_existing(*(workspace / folder / "rig.json" for folder in folders))), None)


def _about_pictures(workspace: Path) -> list[Path]:
    """Files that say what the pictures are."""
    images, rig = workspace / "images", rig_file(workspace)
    return [images / "manifest.csv", images / "survey.json", *([] if rig is None else [rig])]


def _mapping_inputs(workspace: Path) -> list[Path]:
    images = workspace / "images"
    rows = read_manifest(images / "manifest.csv")
    files = [*(row.image for row in rows), *(row.mask for row in rows if row.mask)]
    return [*_about_pictures(workspace), *(images / file for file in files)]


def _mapping_summary(folder: Path) -> Summary:
    found = records.MappingRecord.read(folder / "mapping.json")
    text = f"{found.registered} of {count(found.total, 'picture')} in the model, in its own gauge"
    return text, {"registered": found.registered, "total": found.total}


def _mapping_shortfall(folder: Path) -> str:
    found = records.MappingRecord.read(folder / "mapping.json")
    few = 2 * found.registered < found.total
    return f"only {found.registered} of {found.total} pictures are in the model" if few else ""


def _placing_inputs(workspace: Path) -> list[Path]:
    known = _existing(workspace / SCALE_FILE, workspace / CONTROL_FILES[0])
    return [workspace / "mapping", *_about_pictures(workspace), *known]


def controls(point: str, known: Collection[str]) -> bool:
    """Whether a picked point, or the marker that it is a corner of, is a known one, by names."""
    return point in known or point.rpartition(".")[0] in known


def _picks_of_control(workspace: Path) -> dict[str, str]:
    """Digest of the picks of points in `control.csv`: all others change nothing."""
    control, *tables = (workspace / name for name in CONTROL_FILES)
    rows = read_csv(control, fault=WorkspaceError)[1] if control.is_file() else ()
    meant = [row for _, row in rows if not next(iter(row.values()), "").startswith("# ")]
    known = {row.get(key, "") for row in meant for key in ("name", "from", "to")} - {""}
    picks = [
        [row.get(key, "") for key in ("image", "point", "x", "y", "sigma_px", "matched_to")]
        for path in (_existing(*tables) if known else ())
        for _, row in read_csv(path, fault=WorkspaceError)[1]
        if controls(row.get("point", ""), known) and (row.get("x") or row.get("y"))
    ]
    return {"picks": content_token(json.dumps(picks).encode())} if picks else {}


def _placing_summary(folder: Path) -> Summary:
    found = records.RegistrationRecord.read(folder / "registration.json")
    text = (
        f"{found.registered} of {count(found.total, 'picture')} registered, "
        f"{found.mean_reprojection_px:.2f} px; {found.scale_source}"
    )
    place = found.georeference
    if (
        place is not None
        and place.scale_of_navigation_sigma
        and "rig" in (found.scale_source or "")
    ):
        share, sigma = place.scale_of_navigation or math.nan, place.scale_of_navigation_sigma
        text += f", that of navigation {share:#.5g} of it, sigma {sigma:.2g}"
    if found.joints:
        text += f"; {len(found.joints) + 1} parts that navigation alone joins, to " + " and ".join(
            f"{math.hypot(joint.sigma_north_m, joint.sigma_east_m, joint.sigma_depth_m):.2g} m"
            for joint in found.joints
        )
    if place is not None and place.mount is not None:
        text += f"; {place.mount.words}"
    return text, found.to_json()


def _model_inputs(workspace: Path) -> list[Path]:
    """The placed model, and the pictures and masks that are in it."""
    sparse, images = workspace / "sparse", workspace / "images"
    pictures = records.CamerasRecord.read(sparse / "cameras.json").images
    files = [*pictures, *(picture.mask for picture in pictures.values() if picture.mask)]
    return [sparse, *(images / file for file in files)]


def _dense_summary(folder: Path) -> Summary:
    found = records.CloudRecord.read(folder / "cloud.json")
    surfaces = [folder / "dem.tif", *sorted(folder.glob("planes/*/dem.tif"))]
    text = f"{count(found.points, 'point')}; surface in {', '.join(str(path) for path in surfaces)}"
    return text, found.to_json()


def _cloud(dense: Path) -> list[Path]:
    """The cloud that mosaics and meshes are made of: an overview where the whole is too large."""
    points = _existing(dense / "cloud.ply") or [dense / "cloud.copc.laz"]
    return [*points, dense / "cloud.json"]


def _mosaic_inputs(workspace: Path) -> list[Path]:
    dense = workspace / "dense"
    planes = sorted((dense / "planes").glob("*/dem.tif"))
    about = _existing(*(path.with_name("plane.json") for path in (dense / "dem.tif", *planes)))
    about += _existing(dense / "moving.csv", workspace / COLOUR_FILE)
    bands = ("dem.tif", "sigma.tif", "count.tif")
    surfaces = [one.with_name(name) for one in (dense / "dem.tif", *planes) for name in bands]
    return [*surfaces, *_cloud(dense), *about, *_model_inputs(workspace)]


def _mosaic_summary(folder: Path) -> Summary:
    texts, values = [], []
    for path in _existing(folder / "mosaic.json", *sorted(folder.glob("planes/*/mosaic.json"))):
        found = records.MosaicRecord.read(path)
        texts.append(f"{found.width_px} x {found.height_px} px in {path.with_suffix('.tif')}")
        values.append(found.to_json())
    return "; ".join(texts), values[0] if values else {}


def _mesh_inputs(workspace: Path) -> list[Path]:
    dense = workspace / "dense"
    about = [dense / "light.json", *_existing(dense / "moving.csv")]
    return [*_cloud(dense), *about, *_model_inputs(workspace)]


def _mesh_summary(folder: Path) -> Summary:
    found = records.MeshRecord.read(folder / "mesh.json")
    text = (
        f"{count(found.triangles, 'triangle')}, {found.textured_share:.0%} textured, in "
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
        read += ["mesh/mesh.glb", "mesh/mesh.json"]
    return [workspace / path for path in read]


def _evaluate_summary(folder: Path) -> Summary:
    score = records.ScoreRecord.read(folder / "score.json").to_json()
    table = text_table(("figure", "value"), list(figure_rows(score)))
    return f"score in {folder / 'score.json'}\n{table}", score


MAPPING = StageSpec(
    name="mapping",
    folder="mapping",
    command="reconstruct",
    about="cameras and points in the model's own gauge",
    version=16,
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
    shortfall=_mapping_shortfall,
    resumes=True,
    reported=("mapping.json",),
)


PLACING = StageSpec(
    name="placing",
    folder="sparse",
    command="reconstruct",
    about="the model placed in the world",
    version=21,
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
    content=_picks_of_control,
    summary=_placing_summary,
    products={"track.csv": "camera track with sigmas", "model": "COLMAP model"},
    reported=(".",),
)


DENSE = StageSpec(
    name="dense",
    folder="dense",
    command="reconstruct",
    about="the surface: depth of every view, fused",
    version=21,
    work="reconstruct.dense.run:run_dense",
    takes=("reconstruct",),
    needs=("image", "placing"),
    settings=only("reconstruct", "dense_scale", "dem_cell_m", "planes", "mask_moving"),
    inputs=_model_inputs,
    summary=_dense_summary,
    resumes=True,
    products={
        **listed_in("dense"),
        "planes": "the same over further planes",
        "cloud.copc.laz": "point cloud (COPC) with colour, normal, sigma",
        "moving": "masks of what moves",
    },
    reported=("dem.tif", "sigma.tif", "plane.json", "planes", "moving.png"),
)


MOSAIC = StageSpec(
    name="mosaic",
    folder="mosaic",
    command="reconstruct",
    about="the orthomosaic, painted on the surface",
    version=16,
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
        **listed_in("mosaic"),
        "planes": "those of further planes",
        "footprints.geojson": "what each picture shows",
    },
    reported=("mosaic.tif", "planes"),
)


MESH = StageSpec(
    name="mesh",
    folder="mesh",
    command="reconstruct",
    about="the textured mesh",
    version=7,
    work="reconstruct.mesh.run:run_mesh",
    takes=("reconstruct",),
    needs=("image", "placing", "dense"),
    settings=only("reconstruct", "mesh_triangles", "mesh_error_px", "mesh_page_px", "mesh_tiles"),
    inputs=_mesh_inputs,
    summary=_mesh_summary,
    products={
        "mesh.glb": "textured mesh",
        "tiles/tileset.json": "the same in full detail as 3D Tiles, where it is large",
    },
    reported=("mesh.glb",),
)


EVALUATE = StageSpec(
    name="evaluate",
    folder="evaluation",
    command="evaluate",
    about="errors against the truth of the simulation",
    version=6,
    work="reconstruct.evaluate.run:run_evaluate",
    takes=("seed",),
    needs=("image", "placing", "dense", "mosaic", "plan"),
    uses=("mesh",),
    settings={"seed": "seed"},
    inputs=_evaluate_inputs,
    summary=_evaluate_summary,
    simulated=True,
    products={"score.json": "errors against the truth"},
    reported=(".",),
)


STAGES = (MAPPING, PLACING, DENSE, MOSAIC, MESH, EVALUATE)
"""In the order in which they run."""
