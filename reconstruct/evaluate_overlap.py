"""The overlaps that a flight reached, from the true poses and the true cameras."""

import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
from shapely.geometry import Polygon
from shapely.ops import unary_union

from alice_survey.artefacts import read_json
from camera_calib.rig import read_rig
from missions.footprint import footprint_polygon
from reconstruct.truth import read_true_poses


def overlaps_reached(workspace: Path, truth: Path) -> dict[str, float]:
    """Shares of a footprint seen again by the next picture and of a swath by the next line.

    Footprints are of the reference camera at its true poses, exactly through the port, on a level
    sea floor of the mean depth.

    Returns:
        `forward_mean`, `forward_least`, `side_mean`, `side_least`; a key is left out where there
        are no two neighbours to compare.
    """
    plan = read_json(workspace / "plan" / "plan.json")
    rig = read_rig(truth / "rig.json")
    name, camera = rig.reference, rig.cameras[rig.reference]
    poses = read_true_poses(truth / "poses.csv")
    with (workspace / "images" / "manifest.csv").open(newline="", encoding="utf-8") as file:
        image_of = {
            int(row["station"]): row["image"]
            for row in csv.DictReader(file)
            if row["camera"] == name
        }
    lines: dict[int, list[Polygon]] = {}
    with (workspace / "flight" / "triggers.csv").open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            pose = poses[image_of[int(row["station"])]]
            polygon = footprint_polygon(camera, pose, plan["seafloor_depth_m"])
            lines.setdefault(int(row["line"]), []).append(polygon)
    forward = [
        one.intersection(other).area / one.area
        for line in lines.values()
        for one, other in pairwise(line)
    ]
    survey = [i for i, line in enumerate(plan["lines"]) if line["kind"] == "survey" and i in lines]
    swaths = [unary_union(lines[i]) for i in survey]
    side = [
        one.intersection(other).area / min(one.area, other.area) for one, other in pairwise(swaths)
    ]
    reached: dict[str, float] = {}
    for kind, shares in (("forward", forward), ("side", side)):
        if shares:
            reached |= {f"{kind}_mean": float(np.mean(shares)), f"{kind}_least": min(shares)}
    return reached
