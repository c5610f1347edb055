"""The Annotate tab: labels and annotations, their areas, other tools' files, and pictures."""

import threading
import time
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from alice_survey.app.report.colours import MOSAIC_FILE
from alice_survey.app.studio.endpoints.base import (
    Call,
    Content,
    Endpoint,
    KeptValue,
    Studio,
    zipped,
)
from alice_survey.core.config import Config
from alice_survey.core.contents import first_fault
from alice_survey.core.errors import AliceError
from alice_survey.core.frames import Array
from reconstruct.annotations.backdrops import backdrops_of
from reconstruct.annotations.formats.registry import FORMATS
from reconstruct.annotations.marks import MarkMeasures, MeasuredMark
from reconstruct.annotations.projection import PIXEL_SIGMA_PX, InPicture, OnPlane, Projector
from reconstruct.annotations.store import (
    change_annotations,
    read_annotations,
    token_of,
)
from reconstruct.annotations.table import (
    EACH,
    HEADER,
    AnnotationTable,
    KnownGround,
    annotation_table,
    ground_of,
    surfaces_of,
)
from reconstruct.annotations.transfer import GEOJSON, exported, frame_of, import_data
from reconstruct.annotations.values import COLOURS, Annotation, AnnotationSet, Label, with_labels

_MAX_BYTES = 64 << 20
_MAX_PICTURES = 8
_AROUND = 0.6
"""Of an outline's extent that is shown around it."""
_MIN_AROUND_PX = 40
_TURN_S = 0.7
"""Time in which surfaces are measured for one request."""
_KINDS = {".json": "application/json", ".csv": "text/csv; charset=utf-8"}


class _Edit(Config):
    token: str
    put: list[Annotation] = Field(default_factory=list)
    """Annotations that are new, or take the place of others of their ids."""
    delete: list[str] = Field(default_factory=list)
    labels: list[Label] | None = None
    """All labels; None where they stay."""


class _Annotate:
    def __init__(self, studio: Studio) -> None:
        self._studio, self._folder = studio, studio.workspace.folder
        self._projector = KeptValue(lambda: Projector(self._folder))
        self._ground = KeptValue(lambda: ground_of(self._folder))
        self._measures = KeptValue(lambda: MarkMeasures(self.ground().pixel, self.projector))
        self._surfaces = KeptValue(lambda: surfaces_of(self._folder))
        self._made: tuple[Hashable, AnnotationTable] | None = None
        self._measuring = threading.Lock()

    def projector(self) -> Projector:
        """The model as it is now."""
        return self._projector.of(self._studio.workspace.state(()))

    def ground(self) -> KnownGround:
        """The known ground of the mosaic as it is now."""
        if not self._studio.workspace.has(MOSAIC_FILE):
            raise AliceError("there is no mosaic yet: run 'alice-survey reconstruct' first")
        return self._ground.of(self._studio.workspace.token(MOSAIC_FILE))

    def _values(self) -> AnnotationSet:
        return read_annotations(self._folder, frame_of(self._folder))

    def all(self, call: Call) -> dict[str, Any]:
        """Labels and annotations, and the token of both."""
        token = token_of(self._folder)
        values = self._values()
        return {
            "token": token,
            **values.model_dump(mode="json"),
            "colours": COLOURS,
            "formats": [{"name": f.name, "title": f.title} for f in FORMATS.values()],
            "pixel": self.ground().pixel if self._studio.workspace.has(MOSAIC_FILE) else 0,
        }

    def change(self, call: Call) -> dict[str, Any]:
        """Put and delete some, if nobody else did meanwhile."""
        wanted = call.read(_Edit)

        def made(values: AnnotationSet) -> AnnotationSet:
            gone = {*wanted.delete, *(one.id for one in wanted.put)}
            where = {one.id: n for n, one in enumerate(values.annotations)}
            kept = [one for one in values.annotations if one.id not in gone]
            new = sorted(wanted.put, key=lambda one: where.get(one.id, len(where)))
            labels = values.labels if wanted.labels is None else with_labels((), wanted.labels)
            if wanted.labels is not None and len(labels) < len(wanted.labels):
                raise AliceError("the change: a label stands twice in the list")
            try:
                return AnnotationSet(labels=labels, annotations=(*kept, *new))
            except ValidationError as error:
                raise AliceError(f"the change: {first_fault(error)}") from None

        return self._changed(
            change_annotations(self._folder, frame_of(self._folder), made, wanted.token)
        )

    def take(self, call: Call) -> dict[str, Any]:
        """Add the annotations of a tool's file."""
        format_name, token = call.query.get("format", ""), call.query.get("token", "")
        backdrops = backdrops_of(self._folder)
        return self._changed(
            *import_data(self._folder, call.body, format_name, backdrops, token)[:2]
        )

    def _changed(self, token: str, text: str = "") -> dict[str, Any]:
        self._studio.publish("annotations", {"token": token})
        return {"token": token, "text": text}

    def give(self, call: Call) -> Content:
        """The annotations as a file of a tool; several files as a ZIP."""
        name = call.path["format"]
        files = exported(self._folder, name, backdrops_of(self._folder))
        suffix = ".json" if name == GEOJSON else FORMATS[name].suffix
        texts = {f"{name}{end}{suffix}": text.encode() for end, text in files.texts.items()}
        if not files.written:
            reasons = "".join(f"; {line}" for line in files.left_out)
            raise AliceError(f"there are no annotations to write{reasons}")
        if len(texts) > 1:
            return zipped(f"{name}.zip", texts)
        ((file, data),) = texts.items()
        return Content(data=data, kind=_KINDS[suffix], name=file)

    def _table(self, side: float | None) -> AnnotationTable:
        """The tables as files are now; those that were made last are kept. The lock is held."""
        state = self._studio.workspace.state(())
        key = (state, token_of(self._folder), side)
        if self._made is None or self._made[0] != key:
            ground, measures = self.ground(), self._measures.of(state)
            self._made = (key, annotation_table(self._folder, measures, ground, side))
        return self._made[1]

    def table(self, call: Call) -> dict[str, Any]:
        """Area of each annotation in plan, and what labels cover."""
        with self._measuring:
            found = self._table(_side(call))
        return {
            "marks": [_mark(mark) for mark in found.marks],
            "rows": [dict(zip(HEADER, row, strict=True)) for row in found.rows(None)],
            "known": found.ground.area,
            "not_counted": found.lost,
            "sigma_px": PIXEL_SIGMA_PX,
        }

    def surfaces(self, call: Call) -> dict[str, Any]:
        """Areas of the surface and rugosity, once all are measured; some more of them until then.

        `done` of `total` are; the page asks again until these are the same.
        """
        with self._measuring:
            surfaces = self._surfaces.of(self._studio.workspace.state(()))
            if surfaces is None:
                raise AliceError("there is no elevation model to measure surfaces on")
            found = self._table(_side(call))
            parts = found.parts
            waiting = surfaces.waiting(parts)
            until, left = time.monotonic() + _TURN_S, len(waiting)
            for part in waiting:
                surfaces.measure(part)
                left -= 1
                if time.monotonic() > until:
                    break
            answer = {"done": len(parts) - left, "total": len(parts)}
            if left:
                return answer
            surfaces.keep(parts)
            return {
                **answer,
                "each": [dict(zip(EACH, row, strict=True)) for row in found.each(surfaces)],
                "rows": [dict(zip(HEADER, row, strict=True)) for row in found.rows(surfaces)],
                "without_surface": found.not_measured(surfaces),
            }

    def pictures(self, call: Call) -> dict[str, Any]:
        """The pictures that show an annotation, with its outline in a part of each."""
        one = self._annotation(call.path["id"])
        projector = self.projector()
        rings = [np.array(ring, dtype=np.float64) for ring in one.shape.rings]
        lengths = [len(ring) for ring in rings]
        whole = np.concatenate(rings)
        if one.image is None:
            spots = projector.on_surface(whole)
        else:
            spots = projector.to_plane(one.image, whole)
        _check(spots, one)
        shown = projector.shown_in(spots, _MAX_PICTURES)
        return {
            "pictures": [_described(here, lengths) for here in shown],
            "sigma": float(np.median(spots.sigma)),
        }

    def _annotation(self, name: str) -> Annotation:
        found = next((one for one in self._values().annotations if one.id == name), None)
        if found is None:
            raise FileNotFoundError(name)
        return found


def _side(call: Call) -> float | None:
    return call.number("quadrat") if call.query.get("quadrat") else None


def _mark(mark: MeasuredMark) -> dict[str, Any]:
    middle = mark.geometry.centroid
    shape = mark.shape.model_dump(mode="json") if mark.annotation.image is not None else None
    return {
        "id": mark.annotation.id, "east": middle.x, "north": middle.y, "area": mark.area,
        "sigma": mark.sigma, "length": mark.length, "shape": shape,
    }  # fmt: skip


def _described(here: InPicture, lengths: Sequence[int]) -> dict[str, Any]:
    """A picture, the part of it around the outline, and the outline in it."""
    known: Array = here.pixels[np.isfinite(here.pixels).all(axis=1)]
    low, high = known.min(axis=0), known.max(axis=0)
    margin = max(_MIN_AROUND_PX, _AROUND * float((high - low).max()))
    size = np.array(here.size_px)
    corner = np.clip(np.floor(low - margin), 0, size - 1).astype(int)
    end = np.clip(np.ceil(high + margin), corner + 1, size).astype(int)
    rings = np.split(here.pixels, np.cumsum(lengths)[:-1])
    return {
        "image": here.image,
        "crop": [*corner.tolist(), *(end - corner).tolist()],
        "rings": [ring.tolist() for ring in rings],
        "sigma_px": float(np.nanmedian(here.sigma)),
        "seen": float(here.seen.mean()),
    }


def _check(spots: OnPlane, one: Annotation) -> None:
    lost = int((~np.isfinite(spots.points).all(axis=1)).sum())
    if lost == len(spots.points):
        raise AliceError(
            f"none of the {lost} vertices of {one.label!r} meets a known surface: no picture can "
            "be shown"
        )


def endpoints(studio: Studio) -> Sequence[Endpoint]:
    """What the tab asks."""
    tab = _Annotate(studio)
    return (
        Endpoint(path="/api/annotations", answer=tab.all),
        Endpoint(path="/api/annotations/table", answer=tab.table),
        Endpoint(path="/api/annotations/surfaces", answer=tab.surfaces),
        Endpoint(path="/api/annotations/export/{format}", answer=tab.give),
        Endpoint(path="/api/annotations/{id}/pictures", answer=tab.pictures),
        Endpoint(
            path="/api/annotations/change", answer=tab.change, method="POST", writes=True,
            max_bytes=_MAX_BYTES,
        ),
        Endpoint(
            path="/api/annotations/import", answer=tab.take, method="POST", writes=True,
            max_bytes=_MAX_BYTES,
        ),
    )  # fmt: skip
