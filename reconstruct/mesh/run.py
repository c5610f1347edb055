"""The textured mesh: a surface through the cloud, painted by the views that see it best."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.core.config import ReconstructConfig
from alice_survey.core.errors import warn
from alice_survey.core.executor import Executor
from alice_survey.core.records import CloudRecord, MeshRecord
from alice_survey.core.run import progress
from reconstruct.dense.cloud import cloud_in_parts
from reconstruct.light.solve import read_light
from reconstruct.mesh.formats import GLB_AXES, render_oblique, write_glb
from reconstruct.mesh.surface import TriangleMesh, coarser_level, mesh_cloud
from reconstruct.mesh.texture import MeshSetup, Textured, make_texture
from reconstruct.mesh.tiles import TileSetup, write_tiles
from reconstruct.mesh.topology import face_areas
from reconstruct.mosaic.grid import mean_pixel
from reconstruct.ply import open_cloud
from reconstruct.raster import write_png
from reconstruct.views.model import WorldFrame, read_model


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
    scratch = folder / "scratch"
    scratch.mkdir()
    setup = MeshSetup(
        workspace=workspace,
        cloud=open_cloud(cloud_in_parts(dense, scratch, model.frame)),
        offset=np.array(about.offset_east_north_up),
        step=about.thinned_to,
        pixel=mean_pixel(model),
    )
    views = [view for view in model.views if view.image in light.gains]
    error = reconstruct.mesh_error_px * setup.pixel
    mesh, levels = mesh_cloud(setup.cloud, setup.step, error, scratch, executor)
    textured = make_texture(setup, folder, mesh.vertices, mesh.triangles, views, light, executor)
    facts = mesh_facts(mesh, textured, setup, model.frame)
    if len(levels) > 1 or textured.scale < 1.0:  # the mesh has not all of the detail
        while len(levels[-1].cells) > 1:
            levels.append(coarser_level(levels, setup.step, scratch, executor))
        tiles = TileSetup(mesh=setup, folder=folder / "tiles", scratch=scratch / "tiles")
        facts["tiles"] = write_tiles(tiles, levels, model.frame, views, light, executor)
    shutil.rmtree(scratch)
    if facts["textured_share"] < 0.5:
        warn(
            f"only {facts['textured_share']:.0%} of the mesh is seen whole by a picture; the rest "
            "has the colours of the cloud"
        )
    _write_results(folder, textured, facts)


@progress.step("write the mesh")
def _write_results(folder: Path, mesh: Textured, facts: dict[str, Any]) -> None:
    """Write `mesh.glb`, `mesh.json` and `mesh.png`, and drop the pages, which the GLB has."""
    write_glb(folder / "mesh.glb", mesh, {**facts, "axes": GLB_AXES})
    MeshRecord.save(folder / "mesh.json", facts)
    write_png(folder / "mesh.png", render_oblique(mesh))
    for page in mesh.pages:
        page.unlink()


def mesh_facts(
    mesh: TriangleMesh, textured: Textured, setup: MeshSetup, frame: WorldFrame
) -> dict[str, Any]:
    """What the files cannot say."""
    area = face_areas(mesh.vertices, mesh.triangles)
    return {
        "format": "alice-survey mesh",
        "version": 1,
        "triangles": len(mesh.triangles),
        "area": round(float(area.sum()), 6),
        "textured_share": round(float(area[textured.label >= 0].sum() / area.sum()), 6),
        "pages": len(textured.pages),
        "unit": frame.unit,
        "frame": frame.name,
        "vertical_datum": frame.vertical_datum,
        "axes": {"obj_ply": ["east", "north", "up"], "glb": GLB_AXES},
        "offset_east_north_up": setup.offset.tolist(),
        "notes": list(frame.notes),
    }
