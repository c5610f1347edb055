from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from alice_survey.app.report import mesh_copy as copies
from alice_survey.app.report.held import Held
from alice_survey.app.report.mesh_copy import grid_mesh, mesh_copy
from alice_survey.core.artefacts import write_json
from tests.alice_survey.app.report.tiny import SLOPE, tiny_workspace


def test_a_plane_with_a_hole_has_its_area_and_looks_up() -> None:
    east, north = np.linspace(0.05, 0.95, 10), np.linspace(1.95, 0.05, 20)
    heights = SLOPE * np.tile(east, (20, 1))
    heights[5:8, 4:7] = np.nan
    points, faces, places = grid_mesh(east, north, heights)
    mesh = trimesh.Trimesh(vertices=points, faces=faces, process=False)
    whole, lost = 9 * 19 * 0.01, 15 * 0.01  # two of the hole's corners keep half a cell
    assert np.isclose(mesh.area, (whole - lost) * np.hypot(1.0, SLOPE))
    assert (mesh.face_normals[:, 1] > 0.9).all()
    assert len(points) == 200 - 9
    assert np.allclose(points[:, 0] - points[:, 0].min(), places[:, 0] - places[:, 0].min())
    assert np.allclose(points[:, 2] - points[:, 2].min(), places[:, 1].max() - places[:, 1])


def _with_mesh(workspace: Path, triangles: int) -> Held:
    picture = Image.fromarray(np.full((4000, 4000, 3), 120, np.uint8))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    box = trimesh.creation.box()
    box.visual = trimesh.visual.TextureVisuals(
        uv=np.zeros((len(box.vertices), 2)), material=material
    )
    folder = workspace / "mesh"
    write_json(folder / "stage.json", {"took_s": 1.0})
    about = {"area": 12.0, "textured_share": 1.0, "offset_east_north_up": [0.0, 0.0, 0.0]}
    write_json(folder / "mesh.json", {"triangles": triangles, **about})
    (folder / "mesh.glb").write_bytes(trimesh.Scene(box).export(file_type="glb"))
    picture.resize((64, 64)).save(folder / "mesh.png")
    return Held.of(workspace)


def test_a_small_mesh_keeps_its_triangles_and_gets_a_smaller_texture(tmp_path: Path) -> None:
    held = _with_mesh(tiny_workspace(tmp_path), 12)
    found = mesh_copy(held, tmp_path / "copy.glb")
    assert found is not None
    (part,) = trimesh.load_scene(tmp_path / "copy.glb").geometry.values()
    assert len(part.faces) == 12
    texture = part.visual.material.baseColorTexture
    assert max(texture.size) == copies._MAX_TEXTURE_PX
    assert texture.format == "JPEG"


def test_of_a_large_mesh_the_page_shows_the_relief_under_the_mosaic(tmp_path: Path) -> None:
    held = _with_mesh(tiny_workspace(tmp_path), 10_000_000)
    found = mesh_copy(held, tmp_path / "copy.glb")
    assert found is not None
    assert "10,000,000" in found.about
    (part,) = trimesh.load_scene(tmp_path / "copy.glb").geometry.values()
    east, up = part.vertices[:, 0], part.vertices[:, 1]
    assert np.allclose(np.polyfit(east, up, 1)[0], SLOPE, atol=1e-3)
    uv = part.visual.uv
    assert np.allclose(uv[:, 0], (east - east.min()) / 0.8 + 0.00625, atol=2e-3)


def test_no_mesh_no_copy(tmp_path: Path) -> None:
    assert mesh_copy(Held.of(tiny_workspace(tmp_path)), tmp_path / "copy.glb") is None
