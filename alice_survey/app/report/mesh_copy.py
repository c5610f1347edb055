"""A copy of the mesh that is small enough for a page.

Small meshes keep their triangles and get a smaller texture. Of large ones the page shows the
elevation model under the mosaic instead: as many cells as a browser turns smoothly.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

from alice_survey.app.report.held import Held
from alice_survey.app.report.rasters import read_shrunk
from alice_survey.core.frames import Array
from alice_survey.core.records import MeshRecord
from alice_survey.core.run import progress
from alice_survey.kit.document import Figure, Mesh
from alice_survey.kit.words import count

_MAX_TRIANGLES = 250_000
_MAX_TEXTURE_PX = 3072
_MAX_CELLS = 90_000
_QUALITY = 80


@progress.step("thin the mesh")
def mesh_copy(held: Held, glb: Path) -> Mesh | None:
    """Write a light copy to `glb`; None where there is no mesh, or one too large and no mosaic."""
    from alice_survey.kit.figure import shrunk_png

    mesh = held.read(MeshRecord)
    if mesh is None:
        return None
    whole = mesh.triangles <= _MAX_TRIANGLES
    if not whole and not held.has("mosaic"):
        return None
    offset = np.array(mesh.offset_east_north_up)
    scene = _shrunk(held.workspace / "mesh" / "mesh.glb") if whole else _relief(held, offset)
    glb.write_bytes(scene.export(file_type="glb"))
    still = Figure(
        png=shrunk_png(held.workspace / "mesh" / "mesh.png"),
        title="Mesh",
        alt="The mesh seen from above and from the side",
        shows="The mesh from above and from the side.",
    )
    return Mesh(glb=glb, about=mesh_about(mesh), still=still)


def mesh_about(mesh: MeshRecord) -> str:
    """Description of the light copy."""
    triangles = mesh.triangles
    if triangles <= _MAX_TRIANGLES:
        return f"{count(triangles, 'triangle')}, texture shrunk for the page."
    return (
        f"The elevation model under the mosaic, since the mesh's {triangles:,} triangles are "
        "too many for a page."
    )


def _shrunk(path: Path) -> Any:
    """The mesh with smaller textures."""
    import trimesh
    from PIL import Image

    scene = trimesh.load_scene(path)
    for part in scene.geometry.values():
        material = part.visual.material
        if material.baseColorTexture is None:
            continue
        picture = material.baseColorTexture.convert("RGB")
        shrink = max(picture.size) / _MAX_TEXTURE_PX
        if shrink > 1.0:
            size = tuple(max(1, round(side / shrink)) for side in picture.size)
            picture = picture.resize(size, Image.Resampling.LANCZOS)
        material.baseColorTexture = _as_jpeg(picture)
    return scene


def _relief(held: Held, offset: Array) -> Any:
    """The elevation model as triangles under the mosaic, from the origin of the mesh."""
    import trimesh
    from PIL import Image

    (heights,), cell = read_shrunk(held.workspace / "dense" / "dem.tif", [1], _MAX_CELLS)
    rows, columns = heights.shape
    east = cell.c + cell.a * (np.arange(columns) + 0.5)
    north = cell.f + cell.e * (np.arange(rows) + 0.5)
    points, faces, used = grid_mesh(east, north, heights.astype(np.float64).filled(np.nan))
    points -= offset[[0, 2, 1]] * [1.0, 1.0, -1.0]
    path = held.workspace / "mosaic" / "mosaic.tif"
    bands, at = read_shrunk(path, [1, 2, 3], _MAX_TEXTURE_PX**2)
    high, wide = bands.shape[1:]
    uv = (used - [at.c, at.f + at.e * high]) / [at.a * wide, -at.e * high]
    picture = _as_jpeg(Image.fromarray(np.moveaxis(np.ma.getdata(bands), 0, -1)))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices=points, faces=faces, visual=visual, process=False)
    return trimesh.Scene(mesh)


def grid_mesh(east: Array, north: Array, heights: Array) -> tuple[Array, Array, Array]:
    """Triangles between the known heights of a grid.

    Args:
        east: (W,) of the columns.
        north: (H,) of the rows, falling.
        heights: (H, W); NaN where unknown.

    Returns:
        (V, 3) vertices as glTF has them (x east, y up, z south), (T, 3) faces,
        and (V, 2) east and north of the vertices.
    """
    known = np.isfinite(heights)
    number = np.cumsum(known.ravel()).reshape(known.shape) - 1
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    there = [known[:-1, :-1], known[:-1, 1:], known[1:, :-1], known[1:, 1:]]
    first = there[0] & there[2] & there[1]
    second = there[1] & there[2] & there[3]
    upper, lower = np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)
    faces = np.concatenate([upper[first], lower[second]])
    easts, norths = np.meshgrid(east, north)
    places = np.column_stack([easts[known], norths[known]])
    up = heights[known]
    return np.column_stack([places[:, 0], up, -places[:, 1]]), faces, places


def _as_jpeg(picture: Any) -> Any:
    """A picture that exporters write as JPEG."""
    from PIL import Image

    data = io.BytesIO()
    picture.save(data, "JPEG", quality=_QUALITY)
    return Image.open(data)
