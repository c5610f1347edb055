"""Annotations of other tools into a workspace, and out of it."""

import json
from pathlib import Path
from typing import Any

from alice_survey.core.artefacts import atomic_path
from alice_survey.core.errors import AliceError, WorkspaceError, why
from reconstruct.annotations.backdrops import Backdrops, backdrops_of
from reconstruct.annotations.formats.common import ToolFiles
from reconstruct.annotations.formats.registry import format_named
from reconstruct.annotations.store import change_annotations, geojson, read_annotations
from reconstruct.annotations.values import AnnotationSet
from reconstruct.views.model import WorldFrame, read_frame

MAX_BYTES = 500 << 20
"""Of a file that is read."""
GEOJSON = "geojson"
"""Written for a GIS, not read."""
_NO_PIXEL = 1e-3


def frame_of(workspace: Path) -> WorldFrame | None:
    """The frame of a workspace's model; None while there is none."""
    path = workspace / "sparse" / "frame.json"
    return read_frame(path) if path.is_file() else None


def import_file(
    workspace: Path, path: Path, format_name: str, *, tiles: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """Add the annotations of a tool's file to those of a workspace.

    What is there already, by label, shape and place, is not added again.

    Args:
        workspace: folder of the survey.
        path: file of the tool.
        format_name: of `FORMATS`.
        tiles: folder of `mosaic-tiles`, where these were annotated.

    Returns:
        What was added, as text and as JSON values.

    Raises:
        ConfigError: there is no such format.
        WorkspaceError: the file is not of the format, or names a picture that is not there.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise WorkspaceError(f"{path}: more than {MAX_BYTES >> 20} MiB: split it")
        data = path.read_bytes()
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read: {why(error)}") from None
    try:
        return import_data(workspace, data, format_name, backdrops_of(workspace, tiles))[1:]
    except AliceError as error:
        raise type(error)(f"{path}: {error}") from None


def import_data(
    workspace: Path, data: bytes, format_name: str, backdrops: Backdrops, token: str | None = None
) -> tuple[str, str, dict[str, Any]]:
    """Add the annotations of a tool's file; see `import_file`.

    Args:
        workspace: folder of the survey.
        data: content of the file.
        format_name: of `FORMATS`.
        backdrops: pictures that it may name.
        token: of the annotations that the writer has seen; None for whatever is there.

    Returns:
        The token of what is there now, and what was added, as text and as JSON values.
    """
    new = format_named(format_name).read(data, backdrops)
    pixel = next((s.plane.scale for s in backdrops.mosaic if s.plane is not None), _NO_PIXEL)
    counts = {"labels": 0, "known": 0}

    def add(values: AnnotationSet) -> AnnotationSet:
        both, counts["known"] = values.with_more(new, pixel)
        counts["labels"] = len(both.labels) - len(values.labels)
        return both

    now = change_annotations(workspace, frame_of(workspace), add, token)
    added = len(new.annotations) - counts["known"]
    text = f"{added} annotations and {counts['labels']} labels added"
    if counts["known"]:
        text += f"; {counts['known']} were there already"
    return now, text, {"added": added, "known": counts["known"], "labels": counts["labels"]}


def exported(workspace: Path, format_name: str, backdrops: Backdrops) -> ToolFiles:
    """The files of a tool with all annotations of a workspace."""
    frame = frame_of(workspace)
    values = read_annotations(workspace, frame)
    if format_name == GEOJSON:
        found = geojson(values, None if frame is None else frame.datum)
        count = len(found["features"])
        left = len(values.annotations) - count
        lines = (f"{left} left out: they are in pictures, not on the mosaic",) if left else ()
        return ToolFiles(texts={"": json.dumps(found) + "\n"}, written=count, left_out=lines)
    return format_named(format_name).write(values, backdrops)


def export_file(
    workspace: Path, path: Path, format_name: str, *, tiles: Path | None = None
) -> tuple[str, dict[str, Any]]:
    """Write the annotations of a workspace for a tool.

    Args:
        workspace: folder of the survey.
        path: of the file; others go next to it.
        format_name: of `FORMATS`, or "geojson".
        tiles: folder of `mosaic-tiles` whose tiles the tool shows in place of the mosaic.

    Returns:
        What was written, as text and as JSON values.

    Raises:
        ConfigError: there is no such format.
        WorkspaceError: there is nothing to write.
    """
    files = exported(workspace, format_name, backdrops_of(workspace, tiles))
    if not files.written:
        reasons = "".join(f"; {line}" for line in files.left_out)
        raise WorkspaceError(f"{workspace} has no annotations to write{reasons}")
    paths = []
    for end, text in files.texts.items():
        one = path.with_name(f"{path.stem}{end}{path.suffix}")
        with atomic_path(one) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")
        paths.append(str(one))
    lines = [f"{files.written} annotations written to {' and '.join(paths)}", *files.left_out]
    return "\n".join(lines), {
        "written": files.written, "files": paths, "left_out": list(files.left_out),
    }  # fmt: skip
