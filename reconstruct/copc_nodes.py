"""The nodes of a COPC file, each read alone: what a view of a cloud of any size needs.

The writer is `reconstruct.copc`. LAZ has no checksums: a node's points are taken only where they
lie inside of its cube.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from alice_survey.core.errors import ReconstructionError, WorkspaceError
from alice_survey.core.frames import Array

if TYPE_CHECKING:
    import laspy

_MAX_NODES = 200_000
"""Of 65,000 points each: 13,000 million points."""
_MAX_POINTS = 1_000_000
"""Of a node; the writer's have some 100,000."""
_DEEPEST = 30
"""Level whose keys still fit in 32 bits."""
_ENTRY = np.dtype(
    [("level", "<i4"), ("key", "<i4", 3), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")]
)
_RECORDS_AT = 100
"""Where the header states the number of its records, which laspy reads one by one."""
_MAX_RECORDS = 1000
_PAGE = -1
"""Count of an entry that stands for a further page."""
_COLOURED = 7
"""Point format of the cloud."""
_LAYERS = 10
"""Of a chunk of that format, besides one for each extra byte."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CopcNodes:
    """Where the points of a file are."""

    path: Path
    header: "laspy.LasHeader"
    centre: Array
    """(3,) of the root's cube, east, north, up."""
    half: float
    """Half an edge of it."""
    spacing: float
    """Of the root's points; half of it at each level down."""
    entries: NDArray[np.void]
    """(N,) records of level, key (x, y, z), offset, size and count, coarse levels first."""

    def cube(self, number: int) -> tuple[Array, float]:
        """Centre (3,) and half an edge of a node."""
        entry = self.entries[number]
        half = self.half / 2.0 ** int(entry["level"])
        return self.centre - self.half + half * (2.0 * entry["key"] + 1.0), half


@dataclass(frozen=True, kw_only=True, eq=False)
class NodePoints:
    """Points of a node, arrays of N rows."""

    enu: Array
    """(N, 3) east, north, up."""
    colours: NDArray[np.uint8]
    """(N, 3) RGB."""
    sigmas: NDArray[np.float32]
    """(N,) standard deviations along the surface's normal."""


def read_nodes(path: Path) -> CopcNodes:
    """The nodes of a file, from all pages of its hierarchy.

    Raises:
        FileNotFoundError: there is no such file.
        ReconstructionError: its points have no colours or sigmas, or it has too many nodes.
        WorkspaceError: it is damaged, or no COPC.
    """
    import laspy
    import laspy.copc  # so that the header's records are known

    try:
        with path.open("rb") as file:
            records = file.read(_RECORDS_AT + 4)[_RECORDS_AT:]
            if int.from_bytes(records, "little") > _MAX_RECORDS:
                raise _damaged(path, "its header has too many records")
            end = file.seek(0, io.SEEK_END)
            file.seek(0)
            header = laspy.LasHeader.read_from(file, read_evlrs=False)
            found = [one for one in header.vlrs if isinstance(one, laspy.copc.CopcInfoVlr)]
            if not found or not header.vlrs.get("LasZipVlr"):
                raise _damaged(path, "its header has no COPC info")
            info = found[0]
            pages, entries, count = [(info.hierarchy_root_offset, info.hierarchy_root_size)], [], 0
            while pages:
                offset, size = pages.pop()
                count += size // _ENTRY.itemsize
                if count > _MAX_NODES:
                    raise ReconstructionError(
                        f"{path.name} has more than {_MAX_NODES:,} nodes, too many to show: "
                        "open it in QGIS or CloudCompare"
                    )
                if size < 1 or offset + size > end:
                    raise _damaged(path, "a page of its hierarchy is cut off")
                file.seek(offset)
                page = np.frombuffer(file.read(size), _ENTRY)
                entries.append(page[page["count"] != _PAGE])
                further = page[page["count"] == _PAGE]
                pages += zip(further["offset"].tolist(), further["size"].tolist(), strict=True)
    except (laspy.errors.LaspyException, ValueError, OverflowError) as error:
        raise _damaged(path, str(error)) from error
    format_id = header.point_format.id
    if format_id != _COLOURED or "sigma" not in header.point_format.dimension_names:
        raise ReconstructionError(
            f"{path.name} has points of format {format_id}, or without sigmas, which are not "
            f"shown: delete it and run its stage again (format {_COLOURED}, with sigmas)"
        )
    nodes = np.concatenate(entries)
    nodes = nodes[np.lexsort((*nodes["key"].T[::-1], nodes["level"]))]
    edge = np.int64(1) << nodes["level"].clip(0, _DEEPEST)
    inside = (nodes["key"] >= 0) & (nodes["key"] < edge[:, None])
    is_level = (nodes["level"] >= 0) & (nodes["level"] <= _DEEPEST)
    if not (
        inside.all()
        and is_level.all()
        and (nodes["count"] >= 0).all()
        and (nodes["offset"] <= end).all()
        and (nodes["level"] == 0).sum() == 1
    ):
        raise _damaged(path, "its hierarchy has no root, or nodes outside of it or of the file")
    return CopcNodes(
        path=path, header=header, centre=info.center, half=info.halfsize, spacing=info.spacing,
        entries=nodes,
    )  # fmt: skip


def read_node(nodes: CopcNodes, number: int) -> NodePoints:
    """The points of a node, which has one or more.

    Raises:
        FileNotFoundError: the file is gone.
        ReconstructionError: the node is too large.
        WorkspaceError: it is damaged.
    """
    import lazrs

    entry, path = nodes.entries[number], nodes.path
    count, size = int(entry["count"]), int(entry["size"])
    if count > _MAX_POINTS:
        raise ReconstructionError(
            f"a node of {path.name} has {count:,} points: at most {_MAX_POINTS:,} are shown"
        )
    with path.open("rb") as file:
        file.seek(int(entry["offset"]))
        packed = file.read(size) if size > 0 else b""
    header = nodes.header
    if len(packed) != size or not _is_whole(packed, header, count):
        raise _damaged(path, f"node {number} is cut off, or no chunk of {count:,} points")
    raw = np.zeros(count * header.point_format.size, np.uint8)
    (laz,) = header.vlrs.get("LasZipVlr")
    whole = lazrs.DecompressionSelection(lazrs.SELECTIVE_DECOMPRESS_ALL)
    try:
        lazrs.decompress_points_with_chunk_table(
            packed, laz.record_data, raw, [(count, size)], whole
        )
    except lazrs.LazrsError as error:
        raise _damaged(path, f"node {number}: {error}") from error
    points = raw.view(header.point_format.dtype())
    steps = np.stack([points[axis] for axis in "XYZ"], axis=1)
    enu = steps * header.scales + header.offsets
    centre, half = nodes.cube(number)
    if not np.abs(enu - centre).max() <= half + header.scales.max():
        raise _damaged(path, f"node {number} has points outside of its cube")
    colours = np.stack([points[name] for name in ("red", "green", "blue")], axis=1) >> 8
    return NodePoints(
        enu=enu, colours=colours.astype(np.uint8), sigmas=points["sigma"].astype(np.float32)
    )


def _is_whole(packed: bytes, header: "laspy.LasHeader", count: int) -> bool:
    """Whether a chunk's layers are as long as it says: lazrs takes memory for them unseen.

    After its first point as it is, a chunk of LAZ 1.4 has the number of its points and the sizes
    of its layers, four bytes each, then the layers.
    """
    layout = header.point_format
    layers = _LAYERS + layout.num_extra_bytes
    start = layout.size + 4 * (1 + layers)
    if len(packed) < start:
        return False
    stated = np.frombuffer(packed, "<u4", 1 + layers, layout.size).astype(np.int64)
    return bool(stated[0] == count and start + stated[1:].sum() == len(packed))


def _damaged(path: Path, how: str) -> WorkspaceError:
    return WorkspaceError(f"{path}: is damaged ({how}): delete it and run its stage again")
