"""How well the mesh of a simulated survey fits the true sea floor, and what of it is missing."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial.transform import RigidTransform
from shapely.geometry import MultiPolygon

from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array
from alice_survey.core.records import MeshRecord
from alice_survey.core.run import progress
from alice_survey.sim.seafloor.terrain import Terrain
from reconstruct.evaluate.figures import shares_within, spread
from reconstruct.evaluate.truth import surface_depth, surface_distance

_SAMPLES = 200_000


def read_mesh(folder: Path) -> tuple[Array, Array]:
    """Vertices of `mesh.ply`, (V, 3) NED metres in float64, and triangles, (T, 3).

    Raises:
        WorkspaceError: the file holds no triangles.
    """
    import open3d as o3d

    offset = np.array(MeshRecord.read(folder / "mesh.json").offset_east_north_up)
    mesh = o3d.io.read_triangle_mesh(str(folder / "mesh.ply"))
    if not len(mesh.triangles):
        raise WorkspaceError(f"{folder / 'mesh.ply'}: holds no triangles")
    enu = np.asarray(mesh.vertices, dtype=np.float64) + offset
    return enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0], np.asarray(mesh.triangles)


@progress.step("score the mesh")
def score_mesh(
    vertices_ned: Array,
    triangles: Array,
    area: MultiPolygon,
    terrain: Terrain,
    truth_from_world: RigidTransform,
    ground_pixel_m: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Distances of points spread evenly over the mesh from the truth, and of the truth from it.

    Args:
        vertices_ned: (V, 3) metres.
        triangles: (T, 3) corners.
        area: the survey area, x north and y east; only what lies in it counts.
        terrain: the truth.
        truth_from_world: alignment from the model's to the true NED.
        ground_pixel_m: side of a pixel on the sea floor.
        rng: draws the points.
    """
    shapely.prepare(area)
    vertices = truth_from_world.apply(vertices_ned)
    points = spread_over(vertices, triangles, _SAMPLES, rng)
    points = points[shapely.contains_xy(area, points[:, 0], points[:, 1])]
    distance = 1e3 * surface_distance(terrain, points) if len(points) else np.empty(0)
    low, high = np.array(area.bounds).reshape(2, 2)
    places = rng.uniform(low, high, (_SAMPLES, 2))
    places = places[shapely.contains_xy(area, places[:, 0], places[:, 1])]
    truth = np.column_stack([places, surface_depth(terrain, places)])
    away = distance_from_mesh(vertices, triangles, truth[np.isfinite(truth[:, 2])])
    return {
        "triangles": len(triangles),
        **spread("distance", distance),
        "completeness_within_px": shares_within(away, ground_pixel_m, max(len(places), 1)),
    }


def spread_over(vertices: Array, triangles: Array, count: int, rng: np.random.Generator) -> Array:
    """`count` points, evenly by area, on a mesh (uniform barycentric coordinates by reflection)."""
    corners = vertices[triangles]
    sides = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    chosen = rng.choice(len(triangles), count, p=size / size.sum())
    share = rng.random((count, 2))
    over = share.sum(axis=1) > 1
    share[over] = 1 - share[over]
    points: Array = corners[chosen, 0] + np.einsum("nk,nkj->nj", share, sides[chosen])
    return points


def distance_from_mesh(vertices: Array, triangles: Array, points: Array) -> Array:
    """(N,) distances of (N, 3) points from a mesh; in float32 about its centre."""
    import open3d as o3d

    centre = vertices.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor((vertices - centre).astype(np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
    )
    found = scene.compute_distance(o3d.core.Tensor((points - centre).astype(np.float32)))
    distance: Array = found.numpy().astype(np.float64)
    return distance
