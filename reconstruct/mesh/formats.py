"""Textured meshes as GLB, from it as OBJ with MTL, and a picture of one seen at a slant.

trimesh writes the GLB; pages of texture go in as they are encoded, without a second loss, and the
material says that light is in the picture already (KHR_materials_unlit).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.frames import Array
from alice_survey.core.run import progress
from reconstruct.mesh.texture import Textured, remap
from reconstruct.mesh.topology import face_normals, vertex_normals
from reconstruct.mesh.visibility import ray_scene
from reconstruct.pictures.undistorted import read_colour

_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
_UNLIT = "KHR_materials_unlit"
GLB_AXES = "x = east, y = up, z = -north (y up, as glTF has it)"
_WIDTH_PX = 1200
_SAMPLES = 2
"""Rays a pixel along either axis."""
_ELEVATION_DEG, _AZIMUTH_DEG = 40.0, 200.0
"""Of the eye over the horizon, and where it stands, from north over east."""
_ROWS = 128
_BACK = 255.0


def write_glb(path: Path, mesh: Textured, extras: dict[str, Any]) -> None:
    """Write binary glTF: one mesh and one material a page; pages as JPEG inside."""
    import trimesh
    from PIL import Image
    from trimesh.exchange.gltf import export_glb

    y_up = mesh.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    faces = mesh.wedges.vertex[mesh.wedges.triangles].astype(np.int32)
    normals = vertex_normals(mesh.vertices, faces)[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    scene: Any = trimesh.Scene()
    for number, page in enumerate(mesh.pages):
        used, corner = np.unique(mesh.wedges.triangles[mesh.page == number], return_inverse=True)
        vertex = mesh.wedges.vertex[used]
        material = trimesh.visual.material.PBRMaterial(
            name=page.stem,
            baseColorTexture=Image.new("RGB", (1, 1), (number // 256, number % 256, 0)),
            metallicFactor=0.0,
            roughnessFactor=1.0,
            doubleSided=True,
        )
        scene.add_geometry(
            trimesh.Trimesh(
                vertices=y_up[vertex],
                faces=corner.reshape(-1, 3),
                vertex_normals=normals[vertex],
                visual=trimesh.visual.TextureVisuals(uv=mesh.uv[used], material=material),
                process=False,
            ),
            node_name=page.stem,
            geom_name=page.stem,
        )

    def put_pages(buffers: Any, tree: Any) -> None:
        keys = list(buffers)
        for image, page in zip(tree["images"], mesh.pages, strict=True):
            content = page.read_bytes()
            image["mimeType"] = "image/jpeg"
            buffers[keys[image["bufferView"]]] = content + b"\0" * (-len(content) % 4)

    def finish(tree: Any) -> None:
        tree["asset"] = {"version": "2.0", "generator": "alice-survey", "extras": extras}
        tree["extensionsUsed"] = [_UNLIT]
        tree["samplers"] = [
            {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ]
        for texture in tree["textures"]:
            texture["sampler"] = 0
        for material in tree["materials"]:
            material["extensions"] = {_UNLIT: {}}

    content = export_glb(
        scene, include_normals=True, buffer_postprocessor=put_pages, tree_postprocessor=finish
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_obj(
    path: Path, glb: Path, places: Callable[[Array], Array], comments: Sequence[str]
) -> None:
    """Write what a file of `write_glb` holds as OBJ, and next to it MTL and the pages.

    Args:
        path: of the OBJ.
        glb: to read.
        places: takes vertices (V, 3), east, north, up, to what is written.
        comments: lines for the header.
    """
    import trimesh

    scene, first = trimesh.load_scene(glb, process=False), 1
    material = path.with_suffix(".mtl")
    with path.open("w") as file, material.open("w") as materials:
        file.writelines(f"# {line}\n" for line in [*comments])
        file.write(f"mtllib {material.name}\n")
        for name, part in scene.geometry.items():
            page = path.with_name(f"{name}.jpg")
            part.visual.material.baseColorTexture.save(page, quality="keep", subsampling="keep")
            materials.write(f"newmtl {name}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\n")
            materials.write(f"map_Kd {page.name}\n")
            file.write(f"usemtl {name}\n")
            enu = part.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
            np.savetxt(file, places(enu), fmt="v %.8g %.8g %.8g")
            np.savetxt(file, part.visual.uv, fmt="vt %.7g %.7g")
            corners = np.repeat(part.faces + first, 2, axis=1)
            np.savetxt(file, corners, fmt="f %d/%d %d/%d %d/%d")
            first += len(enu)


@progress.step("draw the mesh")
def render_oblique(mesh: Textured) -> NDArray[np.uint8]:
    """Draw a mesh whose pages exist, (H, W, 3) BGR on white, by parallel rays at a slant."""
    elevation, azimuth = np.deg2rad([_ELEVATION_DEG, _AZIMUTH_DEG])
    forward = -np.array([np.sin(azimuth), np.cos(azimuth), np.tan(elevation)]) * np.cos(elevation)
    right = np.cross(forward, [0.0, 0.0, 1.0]) / np.cos(elevation)
    down = np.cross(forward, right)
    local = mesh.vertices @ np.stack([right, down, forward], axis=1)
    low, high = local.min(axis=0), local.max(axis=0)
    side = max(high[0] - low[0], 0.5 * (high[1] - low[1])) / (_WIDTH_PX * _SAMPLES)
    columns, rows = np.ceil((high[:2] - low[:2]) / side).astype(int) + 1
    x = low[0] + (np.arange(columns) + 0.5) * side
    y = low[1] + (np.arange(rows) + 0.5) * side
    corners = mesh.wedges.vertex[mesh.wedges.triangles].astype(np.int32)
    scene, normals = ray_scene((mesh.vertices, corners)), face_normals(mesh.vertices, corners)
    pages = [read_colour(page) for page in mesh.pages]
    picture = np.empty((rows, columns, 3), np.uint8)
    for top in range(0, rows, _ROWS):
        across = y[top : top + _ROWS, None, None] * down + (low[2] - side) * forward
        starts = (x[:, None] * right + across).reshape(-1, 3)
        rays = np.concatenate([starts, np.broadcast_to(forward, starts.shape)], axis=1)
        colour = _shade(mesh, scene, normals, pages, rays.astype(np.float32))
        picture[top : top + _ROWS] = np.rint(colour).reshape(-1, columns, 3)
    size = (columns // _SAMPLES, rows // _SAMPLES)
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def _shade(
    mesh: Textured,
    scene: Any,
    normals: Array,
    pages: list[NDArray[np.uint8]],
    rays: NDArray[np.float32],
) -> NDArray[np.float32]:
    import open3d as o3d

    hit = scene.cast_rays(o3d.core.Tensor(rays))
    seen = np.flatnonzero(np.isfinite(hit["t_hit"].numpy()))
    face = hit["primitive_ids"].numpy()[seen].astype(np.int64)
    share = hit["primitive_uvs"].numpy()[seen].astype(np.float64)
    weights = np.column_stack([1 - share.sum(axis=1), share])
    uv = np.einsum("nkc,nk->nc", mesh.uv[mesh.wedges.triangles[face]], weights)
    colour = np.full((len(rays), 3), _BACK, np.float32)
    light = np.array([-0.35, 0.35, 0.87])
    lit = np.clip(0.55 + 0.5 * np.abs(normals[face] @ light), 0.0, 1.05)
    for number, page in enumerate(pages):
        mine = mesh.page[face] == number
        height, width = page.shape[:2]
        at = np.column_stack([uv[mine, 0] * width, (1 - uv[mine, 1]) * height])
        found = remap(page, at, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
        colour[seen[mine]] = np.clip(found * lit[mine][:, None], 0, 255)
    return colour
