"""The dense surface: depth of every view, fused into a DEM and a coloured point cloud.

Steps, each over independent views or tiles and through files, so that memory stays bounded:
prepare pictures, find each view's depth with a few partners, let neighbours confirm it, and, for
each plane, fuse tiles.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.executor import Executor
from alice_survey.core.plane_settings import parse_planes
from alice_survey.core.records import SurfaceRecord
from reconstruct.dense.dem import FILL_CELLS
from reconstruct.dense.matching_trial import (
    Scales,
    find_scales,
    ground_pixel,
    pixels_of,
    probed,
)
from reconstruct.dense.moving import COMPARED, clear_moving, keep_look, mask_moving, show_moving
from reconstruct.dense.plane_rasters import Confirmed, fuse_planes
from reconstruct.dense.pose_part import find_errors_of_poses
from reconstruct.dense.scales import matching_scale, scale_for_cell
from reconstruct.dense.stereo_pairs import (
    PointsInSight,
    choose_partners,
    depths_per_pair,
    neighbours,
)
from reconstruct.dense.view_store import ViewStore
from reconstruct.dense.views import (
    LOOKS,
    ViewTask,
    check_view,
    find_match_sigma,
    find_sigma_factor,
    light_parts,
    looked_at,
    prepare_view,
    refine_view,
    view_depth,
)
from reconstruct.light.solve import solve_light, write_light
from reconstruct.planes import chosen_planes
from reconstruct.views.model import SparseModel, read_model, scaled_view

_PARTNERS = 4
"""Pictures that each is matched with."""
_WITNESSES = 8
"""Neighbouring views that a view's depth is checked against."""


def run_dense(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig
) -> None:
    """Find the surface of a placed model.

    Raises:
        ReconstructionError: the views do not overlap, or no depth was found.
        WorkspaceError: the model is damaged.
    """
    model = read_model(workspace / "sparse")
    planes = chosen_planes(parse_planes(reconstruct.planes), model)
    store = ViewStore(folder / "scratch")
    store.folder.mkdir(parents=True, exist_ok=True)
    partners = choose_partners(model, _PARTNERS)
    points = PointsInSight(model)
    scales = _scales(workspace, model, partners, points, reconstruct, executor)
    views = [scaled_view(view, scales.depth) for view in model.views]
    matching = scales.matching / scales.depth

    def tasks(others: Sequence[Sequence[int]]) -> list[ViewTask]:
        return [
            ViewTask(store=store, index=n, view=view, others=tuple((m, views[m]) for m in chosen))
            for n, (view, chosen) in enumerate(zip(views, others, strict=True))
        ]

    prepare = partial(prepare_view, workspace)
    _drain(executor.map(prepare, tasks([()] * len(views)), label="even out pictures"))
    to_match = tasks(partners)
    probes = [(to_match[n], points.of(n)) for n in probed(partners)]
    match_sigma_px = find_match_sigma(matching, probes, executor)
    match = partial(view_depth, matching, match_sigma_px)
    matched = ((task, points.of(task.index)) for task in to_match)
    _drain(executor.map(match, matched, label="match", total=len(views)))
    looks = [looked_at(views, n, chosen) for n, chosen in enumerate(partners)]
    refine = partial(refine_view, matching, on_gpu=executor.uses_gpu)
    _drain(executor.map(refine, tasks(looks), label="refine"))
    checks = tasks(neighbours(model, _WITNESSES))
    sigma_factor = find_sigma_factor(checks, executor)
    check = partial(check_view, sigma_factor)
    nodes, samples = zip(*executor.map(check, checks, label="cross-check"), strict=True)
    images, cameras = [view.image for view in views], [view.camera for view in views]
    light = solve_light(light_parts(store, samples, executor), np.stack(nodes), images, cameras)
    write_light(folder / "light.json", light)
    factors = [light.factors(camera, image) for camera, image in zip(cameras, images, strict=True)]
    store.save_factors(np.stack(factors))
    moving = []
    clear_moving(folder)
    if reconstruct.mask_moving:
        _drain(executor.map(keep_look, tasks([()] * len(views)), label="even out light"))
        mask = partial(mask_moving, workspace, folder)
        others = tasks(neighbours(model, COMPARED))
        moving = list(executor.map(mask, others, label="mask what moves"))
        show_moving(workspace, folder, moving)
    confirmed = Confirmed(
        store=store,
        model=replace(model, views=tuple(views)),
        sigma_factor=sigma_factor,
        shared=depths_per_pair(
            [
                [m for m in chosen if views[m].station != views[n].station]
                for n, chosen in enumerate(looks)
            ]
        ),
        poses=find_errors_of_poses(workspace, model),
        executor=executor,
    )
    made = fuse_planes(confirmed, folder, planes, reconstruct.dem_cell_m)
    SurfaceRecord.save(
        folder / "surface.json",
        {
            "format": "alice-survey surface",
            "version": 1,
            "depth_scale": scales.depth,
            "matching_scale": scales.matching,
            "match_sigma_px": match_sigma_px,
            "refined_with": LOOKS,
            "sigma_factor": round(sigma_factor, 3),
            "pose_sigma": made[0].pose_sigma,
            "cell": made[0].grid.cell,
            "unit": model.frame.unit,
            "rows": made[0].grid.rows,
            "columns": made[0].grid.columns,
            "frame": model.frame.name,
            "vertical_datum": model.frame.vertical_datum,
            "planes": [fused.plane.name for fused in made],
            "pairs": sum(len(chosen) for chosen in partners),
            "moving": {
                "pictures": len(moving),
                "masked": sum(one.masked > 0 for one in moving),
                "masked_share": float(np.mean([one.masked for one in moving] or [0.0])),
            },
            "gaps_bridged_cells": FILL_CELLS,
            "notes": list(model.frame.notes),
        },
    )
    shutil.rmtree(store.folder)


def _scales(
    workspace: Path,
    model: SparseModel,
    partners: Sequence[Sequence[int]],
    points: PointsInSight,
    reconstruct: ReconstructConfig,
    executor: Executor,
) -> Scales:
    """As settings want them; what they leave open is tried out."""
    if reconstruct.dense_scale is not None:
        wanted = reconstruct.dense_scale
        smallest = min(matching_scale(pixels_of(view), wanted) for view in model.views)
        return Scales(depth=wanted, matching=smallest)
    finest = scale_for_cell(reconstruct.dem_cell_m, ground_pixel(model.views, points.of))
    return find_scales(workspace, model.views, partners, points.of, finest, executor)


def _drain(results: Iterator[None]) -> None:
    for _ in results:
        pass
