"""The points of the dense cloud: which nodes it has, and the points of each."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from alice_survey.app.report.held import Held
from alice_survey.app.studio.endpoints.base import Call, Content, Endpoint, KeptValue, Studio
from alice_survey.app.studio.endpoints.model import plane_json
from alice_survey.app.studio.paths import worked_on
from alice_survey.core.records import SurfaceRecord
from reconstruct.copc_nodes import CopcNodes, read_node, read_nodes

_CLOUD = "dense/cloud.copc.laz"


class _Cloud:
    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        path = studio.workspace.folder / _CLOUD
        self._kept = KeptValue(lambda: read_nodes(path))

    @contextmanager
    def _nodes(self) -> Iterator[tuple[str, CopcNodes]]:
        """The cloud's version and nodes; one that is replaced meanwhile is to be loaded again."""
        with self.studio.workspace.unchanged([_CLOUD]) as state:
            version = state[-1]
            if not version:
                raise FileNotFoundError(_CLOUD)
            yield version, self._kept.of(version)

    def about(self, call: Call) -> dict[str, Any]:
        """All nodes: level, x, y, z among those of the level, and points of each."""
        with self._nodes() as (version, nodes):
            held = Held.of(self.studio.workspace.folder)
            surface = held.read(SurfaceRecord)
            entries = nodes.entries
            return {
                "version": version,
                "points": nodes.header.point_count,
                "centre": nodes.centre.tolist(),
                "half": nodes.half,
                "spacing": nodes.spacing,
                "cell": None if surface is None else surface.cell,
                "low": nodes.header.mins.tolist(),
                "high": nodes.header.maxs.tolist(),
                "nodes": np.column_stack(
                    [entries["level"], entries["key"], entries["count"]]
                ).tolist(),
                "unit": held.unit,
                "plane": plane_json(held),
            }

    def node(self, call: Call) -> Content:
        """Points of a node, by its number among all of the cloud's version.

        Places from its centre (east, north, up; three float32 a point), then their sigmas
        (float32), then their colours (red, green, blue; three bytes), all little-endian.
        """
        number = call.whole("number")
        with self._nodes() as (version, nodes):
            if call.query.get("v") != version:
                raise worked_on()
            if number >= len(nodes.entries) or not nodes.entries[number]["count"]:
                raise FileNotFoundError(str(number))
            points = read_node(nodes, number)
            centre, _ = nodes.cube(number)
        parts = ((points.enu - centre).astype("<f4"), points.sigmas.astype("<f4"), points.colours)
        return Content(
            data=b"".join(part.tobytes() for part in parts),
            kind="application/octet-stream",
            tag=f"{version}-{number}",
        )


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """Of the cloud."""
    cloud = _Cloud(studio)
    return (
        Endpoint(path="/api/model/points", answer=cloud.about),
        Endpoint(path="/api/model/points/{number}", answer=cloud.node),
    )
