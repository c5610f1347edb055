"""A survey against an independent cloud or elevation model of the same place."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from alice_survey.core.artefacts import need_stage, refuse_links
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import ReferenceRecord, RegistrationRecord
from alice_survey.core.run import progress
from reconstruct.evaluate.cloud_files import read_own_cloud, read_reference
from reconstruct.evaluate.cloud_registration import (
    CloudDistances,
    CloudFit,
    ReferenceSurface,
    covers,
    distances,
    register_cloud,
)
from reconstruct.evaluate.figures import WITHIN_PX, fit_doming, rounded
from reconstruct.evaluate.plots import plot_reference
from reconstruct.placing.alignment import Similarity
from reconstruct.views.model import SparseModel, points_of_views, read_model

_NAVIGATION = "navigation"


def ground_pixel_of(model: SparseModel) -> float:
    """Median side of a pixel on the surface, from the points that each view sees."""
    pixels = []
    for view, seen in zip(model.views, points_of_views(model), strict=True):
        if len(seen):
            depth = view.world_from_cam.inv().apply(seen)[:, 2]
            pixels.append(depth / view.pinhole.focal_px)
    return float(np.median(np.concatenate(pixels)))


@progress.step("compare with the reference")
def evaluate_reference(
    workspace: Path,
    reference: Path,
    *,
    free_scale: bool | None = None,
    out: Path | None = None,
) -> tuple[str, dict[str, Any]]:
    """Compare the cloud of a workspace with a LAZ, LAS, PLY or GeoTIFF of the same place.

    Both are brought together by their georeferences, then by closest points: rigidly where the
    scale of the survey was observed (rig, bar, control points), with a free scale that is
    reported where it comes from navigation or is not known. Writes `reference.json` and
    `reference.png` into `reference/` of the workspace, or `out`.

    Args:
        workspace: with a finished surface.
        reference: the file.
        free_scale: overrules where the scale is held.
        out: folder to write to.

    Returns:
        A few lines of text, and figures as JSON values.

    Raises:
        WorkspaceError: something is missing, or the survey has no georeference.
        ReconstructionError: the two show different places.
    """
    sparse = need_stage(workspace, "sparse", "reconstruct")
    model = read_model(sparse)
    if model.frame.datum is None:
        raise WorkspaceError(
            f"{workspace} is not georeferenced: a reference is compared where the georeference "
            "puts it; give positions in the manifest or control points"
        )
    source = RegistrationRecord.read(sparse / "registration.json").scale_source or "no scale"
    if free_scale is None:
        free_scale = not model.frame.scaled or _NAVIGATION in source
    rng = np.random.default_rng(1)
    own = read_own_cloud(workspace)
    theirs, placed = read_reference(reference, model.frame.datum)
    surface = ReferenceSurface.of(theirs)
    start = lifted(own, surface)
    fit = register_cloud(own, surface, start, free_scale=free_scale, rng=rng)
    moved = fit.reference_from_cloud.apply(own)
    pixel_m = ground_pixel_of(model) * fit.reference_from_cloud.scale
    ours = distances(moved, surface, rng)
    back = distances(theirs, ReferenceSurface.of(moved), rng)
    figures = {
        "format": "alice-survey reference",
        "version": 1,
        "reference": str(reference),
        "reference_has_coordinate_system": placed,
        "ground_pixel_m": rounded(pixel_m, 6),
        "registration": _registration(fit, own, free_scale=free_scale, source=source),
        "survey_to_reference": ours.to_json(pixel_m),
        "reference_to_survey": back.to_json(pixel_m),
        "completeness_within_px": _completeness(back, pixel_m, all_of_it=False),
        "completeness_of_whole_reference_within_px": _completeness(back, pixel_m, all_of_it=True),
        "doming": fit_doming(ours.points[:, :2], ours.signed_m).to_json(),
    }
    folder = out or workspace / "reference"
    refuse_links(workspace, folder)
    folder.mkdir(parents=True, exist_ok=True)
    plot_reference(folder / "reference.png", ours, back, pixel_m)
    ReferenceRecord.save(folder / "reference.json", figures)
    return _text(figures, folder), figures


def lifted(own: Array, surface: ReferenceSurface) -> Similarity:
    """Where both cover the ground their median heights are made equal: datums often differ.

    Where they share no ground the middles are laid on each other.
    """
    covered = covers(surface, own)
    if covered.any():
        below = own[covered][:: max(1, int(covered.sum()) // 20_000)]
        _, nearest = cKDTree(surface.points[:, :2]).query(below[:, :2])
        shift = np.array([0.0, 0.0, float(np.median(surface.points[nearest, 2] - below[:, 2]))])
    else:
        shift = np.median(surface.points, axis=0) - np.median(own, axis=0)
    return Similarity(scale=1.0, rotation=Rotation.identity(), translation=shift)


def _completeness(back: CloudDistances, pixel_m: float, *, all_of_it: bool) -> dict[str, float]:
    """Share of the reference's points within some ground pixels of the survey's surface."""
    share = back.covered_share if all_of_it else 1.0
    return {
        str(px): round(share * float(np.mean(np.abs(back.signed_m) < px * pixel_m)), 4)
        for px in WITHIN_PX
    }


def _registration(fit: CloudFit, own: Array, *, free_scale: bool, source: str) -> dict[str, Any]:
    pose, middle = fit.reference_from_cloud, own.mean(axis=0)
    shift = pose.apply(middle[None])[0] - middle
    return {
        "transform": "similarity" if free_scale else "rigid",
        "scale_source": source,
        "scale": round(pose.scale, 7),
        "scale_sigma": round(fit.scale_sigma, 7),
        "shift_east_north_up_m": [round(float(v), 4) for v in shift],
        "turn_deg": [round(float(v), 4) for v in np.rad2deg(pose.rotation.as_rotvec())],
        "spread_m": round(fit.spread, 5),
        "rounds": fit.rounds,
    }


def _text(figures: dict[str, Any], folder: Path) -> str:
    ours, back = figures["survey_to_reference"], figures["reference_to_survey"]
    fit = figures["registration"]
    dome = figures["doming"]
    bend = (
        "" if dome["dome_mm"] is None else f"; dome {dome['dome_mm']:.1f} +/- {dome['sigma_mm']} mm"
    )
    scale = f", scale {fit['scale']:.5f}" if fit["transform"] == "similarity" else ""
    return "\n".join([
        f"survey to reference: median {ours['median_m']:.4f} m ({ours['median_px']:.2f} ground "
        f"pixels), rms {ours['rms_m']:.4f} m, 95 % below {ours['95_m']:.4f} m",
        f"reference to survey: median {back['median_m']:.4f} m ({back['median_px']:.2f}), rms "
        f"{back['rms_m']:.4f} m; {figures['completeness_within_px']['3']:.1%} within 3 pixels "
        f"where the survey covers it ({back['covered_share']:.1%}){bend}",
        f"registered ({fit['transform']}{scale}) by {fit['shift_east_north_up_m']} m east, north, "
        "up",
        f"map in {folder / 'reference.png'}",
    ])  # fmt: skip
