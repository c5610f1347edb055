"""A copy of the mesh that is small enough for a page.

Small meshes keep their triangles and get a smaller texture. Of large ones the page shows the
elevation model under the mosaic instead: as many cells as a browser turns smoothly.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.enums import Resampling

from alice_survey.app.report.held import Held
from alice_survey.app.report.rasters import read_shrunk
from alice_survey.core.frames import Array
from alice_survey.core.records import MeshRecord
from alice_survey.core.run import progress
from alice_survey.kit.document import Figure, Mesh
from alice_survey.kit.figure import shrunk_png
from alice_survey.kit.words import count

_MAX_TRIANGLES = 250_000
_MAX_TEXTURE_PX = 3072
_MAX_CELLS = 90_000
_QUALITY = 80
_MAX_STILL_PX = 1600


@progress.step("thin the mesh")
def mesh_copy(held: Held, glb: Path) -> Mesh | None:
    """Write a light copy to `glb`; None where there is no mesh, or one too large and no mosaic."""
    mesh = held.read(MeshRecord)
    if mesh is None:
        return None
    whole = mesh.triangles <= _MAX_TRIANGLES
    if not whole and not held.has("mosaic"):
        return None
    offset = np.array(mesh.offset_east_north_up)
    scene = _shrunk(held.workspace / "mesh" / "mesh.glb") if whole else _relief(held, offset)
    glb.write_bytes(scene.export(file_type="glb"))
    return Mesh(
        glb=glb,
        about=mesh_about(mesh),
        still=mesh_still(held.workspace / "mesh" / "mesh.png"),
    )


def mesh_still(picture: Path, max_px: int = _MAX_STILL_PX) -> Figure:
    """Image of the mesh for print."""
    return Figure(
        png=shrunk_png(picture, max_px),
        title="Mesh",
        alt="The mesh seen from above and from the side",
        shows="The mesh from above and from the side.",
    )


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

    (heights,), _, cell = read_shrunk(held.workspace / "dense" / "dem.tif", [1], _MAX_CELLS)
    rows, columns = heights.shape
    east = cell.c + cell.a * (np.arange(columns) + 0.5)
    north = cell.f + cell.e * (np.arange(rows) + 0.5)
    points, faces, used = grid_mesh(east, north, heights.astype(np.float64).filled(np.nan))
    points -= offset[[0, 2, 1]] * [1.0, 1.0, -1.0]
    with rasterio.open(held.workspace / "mosaic" / "mosaic.tif") as raster:
        shrink = max(1.0, max(raster.width, raster.height) / _MAX_TEXTURE_PX)
        size = (max(1, round(raster.height / shrink)), max(1, round(raster.width / shrink)))
        bands = raster.read([1, 2, 3], out_shape=(3, *size), resampling=Resampling.average)
        over = raster.bounds
    uv = np.column_stack(
        [
            (used[:, 0] - over.left) / (over.right - over.left),
            (used[:, 1] - over.bottom) / (over.top - over.bottom),
        ]
    )
    picture = _as_jpeg(Image.fromarray(np.moveaxis(bands, 0, -1)))
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
    faces = np.concatenate(
        [
            np.stack([a, c, b], axis=-1)[first],
            np.stack([b, c, d], axis=-1)[second],
        ]
    )
    easts, norths = np.meshgrid(east, north)
    places = np.column_stack([easts[known], norths[known]])
    up = heights[known]
    return np.column_stack([places[:, 0], up, -places[:, 1]]), faces, places


def _as_jpeg(picture: Any) -> Any:
    """A picture that exporters write as JPEG."""
    import io

    from PIL import Image

    bgr = cv2.cvtColor(np.asarray(picture), cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Image.open(io.BytesIO(data))
