"""`annotations.json` of a workspace: read, changed by one writer at a time, seen by a GIS."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from filelock import FileLock, Timeout
from pydantic import Field, ValidationError

from alice_survey.core.artefacts import JsonRecord, json_values
from alice_survey.core.contents import first_fault
from alice_survey.core.edited_files import check_token, content_of, content_token
from alice_survey.core.errors import WorkspaceError
from alice_survey.core.frames import Array, Datum
from alice_survey.core.records import PlaceRecord
from reconstruct.annotations.values import Annotation, AnnotationSet, Label
from reconstruct.views.model import WorldFrame, datum_of

FILE = "annotations.json"
_WAIT_S = 10.0
_SAME_DEG = 1e-9


class AnnotationsRecord(JsonRecord):
    """`annotations.json`: labels, and what carries them."""

    path: ClassVar = FILE
    format: Literal["alice-survey annotations"] = "alice-survey annotations"
    version: Literal[1] = 1
    frame: str = "ned"
    """That the plane of the mosaic is in: `ned` (east and north of the datum) or `model`."""
    datum: PlaceRecord | None = None
    labels: tuple[Label, ...] = ()
    annotations: tuple[Annotation, ...] = Field(default=())

    @property
    def values(self) -> AnnotationSet:
        """Its labels and annotations."""
        return AnnotationSet(labels=self.labels, annotations=self.annotations)


def token_of(workspace: Path) -> str:
    """A token of what the file holds; empty where there is none."""
    return content_token(content_of(workspace / FILE))


def read_annotations(workspace: Path, frame: WorldFrame | None = None) -> AnnotationSet:
    """The annotations of a workspace; none where there is no file.

    Args:
        workspace: folder of the survey.
        frame: of its model; those on the mosaic must be in it.

    Raises:
        WorkspaceError: the file is damaged, or its places are of another frame.
    """
    record = AnnotationsRecord.made(workspace / FILE)
    if record is None:
        return AnnotationSet()
    if frame is not None and any(one.image is None for one in record.annotations):
        _check_frame(workspace / FILE, record, frame)
    try:
        return record.values
    except ValidationError as error:
        raise WorkspaceError(f"{workspace / FILE}: {first_fault(error)}") from None


def change_annotations(
    workspace: Path,
    frame: WorldFrame | None,
    change: Callable[[AnnotationSet], AnnotationSet],
    token: str | None = None,
) -> str:
    """Replace the annotations of a workspace, whole or not at all.

    Args:
        workspace: folder of the survey.
        frame: of its model; None while there is none.
        change: from what is there to what shall be.
        token: of what the writer has read; None for whatever is there.

    Returns:
        The token of what was written.

    Raises:
        StaleError: another writer came first.
        WorkspaceError: the file is damaged, cannot be written, or is being written too long.
    """
    try:
        with FileLock(workspace / f".{FILE}.lock", timeout=_WAIT_S):
            check_token(FILE, content_of(workspace / FILE), token)
            values = change(read_annotations(workspace, frame))
            datum = None if frame is None else frame.datum
            AnnotationsRecord(
                frame="ned" if frame is None else frame.name,
                datum=None if datum is None else PlaceRecord(**asdict(datum)),
                labels=values.labels,
                annotations=values.annotations,
            ).write(workspace / FILE)
            return token_of(workspace)
    except Timeout:
        raise WorkspaceError(f"{workspace / FILE} is being written; try again") from None
    except OSError as error:
        raise WorkspaceError(f"{workspace / FILE}: cannot be written: {error.strerror}") from None


def geojson(values: AnnotationSet, datum: Datum | None) -> dict[str, Any]:
    """The annotations on the mosaic for a GIS (RFC 7946).

    Args:
        values: annotations; those in pictures are left out.
        datum: of the frame; without one coordinates stay east and north of the model, which no
            GIS can place, and the file says so.
    """
    features = []
    for one in values.annotations:
        if one.image is not None:
            continue
        label, shape = values.by_label[one.label], one.shape
        rings = [_lon_lat(np.array(ring), datum) for ring in shape.rings]
        closed = [[*ring, ring[0]] for ring in rings]
        kinds: dict[str, tuple[str, Any]] = {
            "point": ("Point", rings[0][0]),
            "polyline": ("LineString", rings[0]),
        }
        kind, coordinates = kinds.get(shape.kind, ("Polygon", closed))
        features.append({
            "type": "Feature",
            "id": one.id,
            "geometry": {"type": kind, "coordinates": coordinates},
            "properties": {
                "label": label.id, "aphia_id": label.aphia_id, "colour": label.colour,
                "kind": shape.kind, "radius": shape.radius, "author": one.author,
                "time_utc": one.time_utc, "note": one.note, **one.attributes,
            },
        })  # fmt: skip
    about = {} if datum is not None else {"about": "coordinates are those of the model: no datum"}
    found: dict[str, Any] = json_values(
        {"type": "FeatureCollection", **about, "features": features}
    )
    return found


def _lon_lat(places: Array, datum: Datum | None) -> list[list[float]]:
    found = places if datum is None else np.round(datum.lon_lat_from_en(places), 10)
    return [[float(x), float(y)] for x, y in found]


def _check_frame(path: Path, record: AnnotationsRecord, frame: WorldFrame) -> None:
    was = None if record.datum is None else datum_of(record.datum)
    now = frame.datum
    same = record.frame == frame.name and (was is None) == (now is None)
    if same and was is not None and now is not None:
        same = (
            abs(was.latitude_deg - now.latitude_deg) < _SAME_DEG
            and abs(was.longitude_deg - now.longitude_deg) < _SAME_DEG
        )
    if not same:
        raise WorkspaceError(
            f"{path}: its places are of the frame {record.frame!r} with another datum than the "
            f"model now has ({frame.name!r}): move the file away, or give the survey the datum back"
        )
