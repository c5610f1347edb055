"""Textured meshes as GLB, OBJ with MTL, and PLY.

Own writers, since a page of texture then stays as it is encoded, one page in memory at a time, and
the material says that light is in the picture already (KHR_materials_unlit). Specifications:
glTF 2.0 (Khronos), Wavefront OBJ, PLY (Turk 1994).
"""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from alice_survey.base.artefacts import atomic_path
from alice_survey.base.frames import Array
from reconstruct.mesh.texture import Textured
from reconstruct.mesh.topology import vertex_normals

_FLOAT, _UINT32 = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
_GLB_MAGIC, _JSON_CHUNK, _BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942

GLB_AXES = "x = east, y = up, z = -north (y up, as glTF has it)"


def write_glb(path: Path, mesh: Textured, extras: dict[str, Any]) -> None:
    """Write binary glTF: one primitive and one material a page; pages as JPEG inside.

    Args:
        path: of the file.
        mesh: with pages that exist.
        extras: JSON values to keep with it.
    """
    y_up = mesh.vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    faces = mesh.wedges.vertex[mesh.wedges.triangles].astype(np.int32)
    normals = vertex_normals(mesh.vertices, faces)
    normals = normals[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    parts: list[NDArray[Any] | Path] = []
    size = 0

    def add(part: NDArray[Any] | Path, target: int | None) -> int:
        nonlocal size
        length = part.stat().st_size if isinstance(part, Path) else part.nbytes
        view: dict[str, Any] = {"buffer": 0, "byteOffset": size, "byteLength": length}
        if target is not None:
            view["target"] = target
        views.append(view)
        parts.append(part)
        size += -(-length // 4) * 4
        return len(views) - 1

    def accessor(values: NDArray[Any], kind: str, target: int, bounded: bool = False) -> int:
        entry: dict[str, Any] = {
            "bufferView": add(values, target),
            "componentType": _UINT32 if values.dtype == np.uint32 else _FLOAT,
            "count": len(values),
            "type": kind,
        }
        if bounded:
            entry["min"] = values.min(axis=0).tolist()
            entry["max"] = values.max(axis=0).tolist()
        accessors.append(entry)
        return len(accessors) - 1

    primitives = []
    for number in range(len(mesh.pages)):
        used, corner = np.unique(mesh.wedges.triangles[mesh.page == number], return_inverse=True)
        vertex = mesh.wedges.vertex[used]
        uv = mesh.uv[used] * [1.0, -1.0] + [0.0, 1.0]  # glTF counts v downwards
        primitives.append(
            {
                "attributes": {
                    "POSITION": accessor(
                        y_up[vertex].astype("<f4"), "VEC3", _ARRAY_BUFFER, bounded=True
                    ),
                    "NORMAL": accessor(normals[vertex].astype("<f4"), "VEC3", _ARRAY_BUFFER),
                    "TEXCOORD_0": accessor(uv.astype("<f4"), "VEC2", _ARRAY_BUFFER),
                },
                "indices": accessor(corner.reshape(-1).astype("<u4"), "SCALAR", _ELEMENT_BUFFER),
                "material": number,
            }
        )
    pictures = [{"bufferView": add(page, None), "mimeType": "image/jpeg"} for page in mesh.pages]
    document = {
        "asset": {"version": "2.0", "generator": "alice-survey", "extras": extras},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "sea floor"}],
        "meshes": [{"primitives": primitives}],
        "materials": [
            {
                "name": page.stem,
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": number},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": {"KHR_materials_unlit": {}},
            }
            for number, page in enumerate(mesh.pages)
        ],
        "textures": [{"sampler": 0, "source": n} for n in range(len(mesh.pages))],
        "samplers": [
            {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ],
        "images": pictures,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        total = 12 + 8 + len(text) + 8 + size
        file.write(np.array([_GLB_MAGIC, 2, total, len(text), _JSON_CHUNK], "<u4").tobytes())
        file.write(text)
        file.write(np.array([size, _BIN_CHUNK], "<u4").tobytes())
        for part in parts:
            _copy(part, file)


def _copy(part: NDArray[Any] | Path, file: BinaryIO) -> None:
    if isinstance(part, Path):
        length = part.stat().st_size
        with part.open("rb") as source:
            shutil.copyfileobj(source, file)
    else:
        length = part.nbytes
        file.write(np.ascontiguousarray(part).tobytes())
    file.write(b"\0" * (-length % 4))


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
    record = np.empty(len(vertices), [("xyz", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
    record["xyz"], record["normal"] = vertices, vertex_normals(vertices, triangles)
    record["colour"] = colours
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        file.write(record.tobytes())
        file.write(faces.tobytes())
