"""Textured meshes as GLB, OBJ with MTL, and PLY.

trimesh writes the GLB; pages of texture go in as they are encoded, without a second loss, and the
material says that light is in the picture already (KHR_materials_unlit).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.frames import Array
from reconstruct.mesh.texture import Textured
from reconstruct.mesh.topology import vertex_normals
from reconstruct.ply import VERTEX, write_ply

_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
_UNLIT = "KHR_materials_unlit"
GLB_AXES = "x = east, y = up, z = -north (y up, as glTF has it)"


def write_glb(path: Path, mesh: Textured, extras: dict[str, Any]) -> None:
    """Write binary glTF: one mesh and one material a page; pages as JPEG inside.

    Args:
        path: of the file.
        mesh: with pages that exist.
        extras: JSON values to keep with it.
    """
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


def write_obj(path: Path, mesh: Textured, comments: Sequence[str]) -> None:
    """Write OBJ and, next to it, MTL that names the pages; x east, y north, z up."""
    material = path.with_suffix(".mtl")
    with atomic_path(material) as temporary:
        temporary.write_text(
            "".join(
                f"newmtl {page.stem}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 0\nmap_Kd {page.name}\n"
                for page in mesh.pages
            )
        )
    with atomic_path(path) as temporary, temporary.open("w") as file:
        file.writelines(f"# {line}\n" for line in comments)
        file.write(f"mtllib {material.name}\n")
        np.savetxt(file, mesh.vertices, fmt="v %.8g %.8g %.8g")
        np.savetxt(file, mesh.uv, fmt="vt %.7g %.7g")
        for number, page in enumerate(mesh.pages):
            wedge = mesh.wedges.triangles[mesh.page == number]
            both = np.stack([mesh.wedges.vertex[wedge], wedge], axis=2).reshape(-1, 6) + 1
            file.write(f"usemtl {page.stem}\n")
            np.savetxt(file, both, fmt="f %d/%d %d/%d %d/%d")


def write_mesh_ply(
    path: Path,
    vertices: Array,
    triangles: NDArray[np.int32],
    colours: NDArray[np.uint8],
    comments: Sequence[str],
) -> None:
    """Write a binary PLY with normals and colours at vertices; x east, y north, z up.

    Args:
        path: of the file.
        vertices: (V, 3).
        triangles: (T, 3).
        colours: (V, 3) RGB.
        comments: lines for its header.
    """
    record = np.empty(len(vertices), VERTEX)
    normals = vertex_normals(vertices, triangles)
    for axis, name in enumerate("xyz"):
        record[name], record[f"n{name}"] = vertices[:, axis], normals[:, axis]
    record["red"], record["green"], record["blue"] = colours.T
    write_ply(path, [record], comments, triangles)
