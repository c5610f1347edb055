"""The textured mesh: a surface through the cloud, painted by the views that see it best."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import warn
from alice_survey.core.executor import Executor
from alice_survey.core.frames import Array
from alice_survey.core.records import CloudRecord, MeshRecord
from alice_survey.core.run import progress
from reconstruct.light.solve import read_light
from reconstruct.mesh.formats import GLB_AXES, render_oblique, write_mesh
from reconstruct.mesh.surface import (
    TRIM_STEPS,
    TriangleMesh,
    coarser_level,
    mesh_cloud,
)
from reconstruct.mesh.texture import Textured, colours_of_cloud, paint
from reconstruct.mesh.tiles import TileSetup, write_tiles
from reconstruct.mesh.topology import face_areas
from reconstruct.mesh.visibility import choose_views, find_candidates, make_charts
from reconstruct.mosaic.grid import mean_pixel
from reconstruct.ply import open_cloud
from reconstruct.raster import write_png
from reconstruct.views.model import WorldFrame, read_model

_PAGE_PX = 8192
"""Largest side of a page of texture."""
_LIFT_STEPS = 0.5
"""Height over the surface, in spacings of the cloud, at which lines of sight start."""


def run_mesh(
    workspace: Path, folder: Path, executor: Executor, *, reconstruct: ReconstructConfig
) -> None:
    """Mesh and texture a finished surface.

    Raises:
        ReconstructionError: the cloud carries no surface.
        WorkspaceError: the model or the cloud is damaged.
    """
    model = read_model(workspace / "sparse")
    dense = workspace / "dense"
    about = CloudRecord.read(dense / "cloud.json")
    light = read_light(dense / "light.json")
    offset, step = np.array(about.offset_east_north_up), about.thinned_to
    pixel = mean_pixel(model)
    views = [view for view in model.views if view.image in light.gains]
    cloud = open_cloud(dense / "cloud.ply")
    scratch = folder / "scratch"
    scratch.mkdir()
    mesh, levels = mesh_cloud(
        cloud,
        step,
        reconstruct.mesh_error_px * pixel,
        scratch,
        executor,
    )
    np.savez(scratch / "mesh.npz", vertices=mesh.vertices, triangles=mesh.triangles, offset=offset)
    candidates = find_candidates(
        scratch / "mesh.npz", len(mesh.triangles), workspace, views, _LIFT_STEPS * step, executor
    )
    label = choose_views(mesh.vertices, mesh.triangles, candidates)
    del candidates
    textured = paint(
        folder,
        mesh.vertices,
        mesh.triangles,
        offset,
        make_charts(mesh.vertices, mesh.triangles, label),
        views,
        workspace,
        light,
        colours_of_cloud(cloud, mesh.vertices, step),
        plain_pixel=pixel,
        page_px=_PAGE_PX,
        executor=executor,
    )
    facts = mesh_facts(mesh, textured, offset, step, model.frame)
    if len(levels) > 1 or textured.scale < 1.0:  # the mesh has not all of the detail
        while len(levels[-1].cells) > 1:
            levels.append(coarser_level(levels, step, scratch, executor))
        setup = TileSetup(
            folder=folder / "tiles",
            scratch=scratch / "tiles",
            workspace=workspace,
            cloud=cloud,
            offset=offset,
            step=step,
            lift=_LIFT_STEPS * step,
            pixel=pixel,
            page_px=_PAGE_PX,
        )
        facts["tiles"] = write_tiles(setup, levels, model.frame, views, light, executor)
    shutil.rmtree(scratch)
    if facts["textured_share"] < 0.5:
        warn(
            f"only {facts['textured_share']:.0%} of the mesh is seen whole by a picture; the rest "
            "has the colours of the cloud"
        )
    _write_results(folder, textured, facts)


@progress.step("write the mesh")
def _write_results(folder: Path, mesh: Textured, facts: dict[str, Any]) -> None:
    """Write `mesh.glb`, `.obj`, `.mtl`, `.ply`, `.json` and `.png` next to the pages."""
    offset = " ".join(repr(value) for value in facts["offset_east_north_up"])
    comments = [
        f"offset_east_north_up {offset}",
        f"frame {facts['frame']}, unit {facts['unit']}, x east, y north, z up",
        f"vertical datum: {facts['vertical_datum']}",
    ]
    write_mesh(folder, mesh, {**facts, "axes": GLB_AXES}, comments)
    MeshRecord.save(folder / "mesh.json", facts)
    write_png(folder / "mesh.png", render_oblique(mesh))


def mesh_facts(
    mesh: TriangleMesh, textured: Textured, offset_enu: Array, step: float, frame: WorldFrame
) -> dict[str, Any]:
    """What the files cannot say."""
    area = face_areas(mesh.vertices, mesh.triangles)
    return {
        "format": "alice-survey mesh",
        "version": 1,
        "triangles": len(mesh.triangles),
        "vertices": len(mesh.vertices),
        "area": round(float(area.sum()), 6),
        "textured_share": round(float(area[textured.label >= 0].sum() / area.sum()), 6),
        "patches": int(textured.wedges.chart.max()) + 1,
        "pages": [page.name for page in textured.pages],
        "texture_scale": round(textured.scale, 6),
        "spacing": step,
        "gaps_bridged": 2 * TRIM_STEPS * step,
        "decimation_error": mesh.error,
        "unit": frame.unit,
        "frame": frame.name,
        "vertical_datum": frame.vertical_datum,
        "axes": {"obj_ply": ["east", "north", "up"], "glb": GLB_AXES},
        "offset_east_north_up": [float(value) for value in offset_enu],
        "notes": list(frame.notes),
    }
