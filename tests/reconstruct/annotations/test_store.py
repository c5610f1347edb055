"""The annotations of a workspace: kept whole, by one writer at a time, and counted by labels."""

import json
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine as GridAffine

from alice_survey.core.edited_files import StaleError
from alice_survey.core.errors import ConfigError, WorkspaceError
from alice_survey.core.frames import Datum
from reconstruct.annotations.marks import MeasuredMark
from reconstruct.annotations.store import (
    FILE,
    change_annotations,
    geojson,
    read_annotations,
    token_of,
)
from reconstruct.annotations.table import KnownGround, quadrats
from reconstruct.annotations.values import Annotation, AnnotationSet, DrawnShape, Label, with_labels
from reconstruct.views.model import WorldFrame

DATUM = Datum(32.8, 34.9)
FRAME = WorldFrame(name="ned", datum=DATUM, scaled=True, vertical_datum="sea surface")
LABELS = with_labels((), [Label(id="coral"), Label(id="sand", colour="#e69f00")])


def square(west: float, south: float, side: float, label: str = "coral") -> Annotation:
    corners = ((west, south), (west + side, south), (west + side, south + side),
               (west, south + side))  # fmt: skip
    return Annotation(label=label, shape=DrawnShape(kind="rectangle", points=corners))


def some(*annotations: Annotation) -> AnnotationSet:
    return AnnotationSet(labels=LABELS, annotations=annotations)


def test_what_is_written_is_there_and_a_second_writer_is_refused(tmp_path: Path) -> None:
    assert read_annotations(tmp_path, FRAME) == AnnotationSet()
    first = change_annotations(tmp_path, FRAME, lambda _: some(square(0, 0, 1)), "")
    assert first == token_of(tmp_path) != ""
    kept = read_annotations(tmp_path, FRAME)
    assert kept.annotations[0].shape.area == 1.0

    def add(now: AnnotationSet) -> AnnotationSet:
        return some(*now.annotations, square(3, 0, 2))

    second = change_annotations(tmp_path, FRAME, add, first)
    assert second != first
    with pytest.raises(StaleError):
        change_annotations(tmp_path, FRAME, lambda _: some(), first)
    assert len(read_annotations(tmp_path, FRAME).annotations) == 2


def test_places_of_another_datum_are_refused(tmp_path: Path) -> None:
    change_annotations(tmp_path, FRAME, lambda _: some(square(0, 0, 1)))
    other = WorldFrame(
        name="ned", datum=Datum(32.9, 34.9), scaled=True, vertical_datum="sea surface"
    )
    with pytest.raises(WorkspaceError, match="datum"):
        read_annotations(tmp_path, other)


@pytest.mark.parametrize(
    ("key", "value"),
    [("annotations", [{"label": "coral"}]), ("labels", []), ("version", 2), ("labels", 3)],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, key: str, value: object) -> None:
    change_annotations(tmp_path, FRAME, lambda _: some(square(0, 0, 1)))
    whole = json.loads((tmp_path / FILE).read_text())
    (tmp_path / FILE).write_text(json.dumps(whole | {key: value}))
    with pytest.raises(WorkspaceError) as caught:
        read_annotations(tmp_path, FRAME)
    assert len(str(caught.value).splitlines()) == 1


def test_a_gis_sees_them_where_they_are() -> None:
    found = geojson(some(square(10, 20, 1)), DATUM)
    (feature,) = found["features"]
    lon, lat = np.array(feature["geometry"]["coordinates"][0]).T
    ned = DATUM.ned_from_geodetic(np.column_stack([lat, lon, np.zeros(5)]))
    np.testing.assert_allclose(ned[:, [1, 0]], [[10, 20], [11, 20], [11, 21], [10, 21], [10, 20]],
                               atol=1e-4)  # fmt: skip
    assert feature["properties"]["label"] == "coral"


def measured(one: Annotation, sigma: float = 0.01) -> MeasuredMark:
    return MeasuredMark(annotation=one, shape=one.shape, area=one.shape.area, sigma=sigma,
                        length=float("nan"), own=())  # fmt: skip


KNOWN = np.ones((40, 60), bool)
KNOWN[:, 40:] = False
GROUND = KnownGround(known=KNOWN, transform=GridAffine(0.1, 0, 0, 0, -0.1, 4), pixel=0.1)
"""4 m by 6 m, of which the western 4 m are known."""


def test_cover_of_all_counts_overlaps_once_and_parts_of_one_thing_once() -> None:
    parts = [
        square(0, 0, 1).model_copy(update={"attributes": {"instance": "a"}}),
        square(2, 2, 1).model_copy(update={"attributes": {"instance": "a"}}),
    ]
    values = some(*parts, square(0.5, 0, 1), square(0, 3, 1, "sand"))
    (whole,) = quadrats(values, [measured(one) for one in values.annotations], GROUND)
    coral, sand = whole.rows
    assert whole.known == pytest.approx(16.0)
    assert (coral.count, sand.count) == (2, 1)
    assert coral.area == pytest.approx(3.0) and coral.cover == pytest.approx(2.5 / 16)
    assert coral.sigma == pytest.approx(0.01 * np.sqrt(3))
    assert sand.cover_sigma == pytest.approx(0.01 / 16)


def test_quadrats_share_out_what_lies_across_them() -> None:
    values = some(square(0.5, 0.5, 1))
    found = quadrats(values, [measured(values.annotations[0])], GROUND, 1.0)
    assert len(found) == 16 and all(one.known == pytest.approx(1.0) for one in found)
    with_coral = {one.name: one.rows[0] for one in found if one.rows}
    assert set(with_coral) == {"0,0", "1,0", "0,1", "1,1"}
    assert all(row.cover == pytest.approx(0.25) for row in with_coral.values())
    assert sum(row.count for row in with_coral.values()) == 1
    assert np.sqrt(sum(row.sigma**2 for row in with_coral.values())) == pytest.approx(0.01)
    with pytest.raises(ConfigError, match="larger"):
        quadrats(values, [], GROUND, 1e-4)
