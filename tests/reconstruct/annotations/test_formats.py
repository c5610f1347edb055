"""What tools write is read as it is meant, and what we write comes back as it was."""

import csv
import io
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rasterio.features import rasterize
from rasterio.transform import Affine as GridAffine
from shapely.geometry import Polygon

from alice_survey.core.errors import AliceError
from reconstruct.annotations.backdrops import Backdrops
from reconstruct.annotations.formats.registry import FORMATS
from reconstruct.annotations.formats.rle import decoded, encoded, outlines, packed, unpacked
from reconstruct.annotations.keyhole import joined, parted
from reconstruct.annotations.values import AnnotationSet, DrawnShape, signed_area
from tests.reconstruct.annotations.marks import (
    BACKDROPS,
    LABELS,
    PIXEL,
    TILES,
    WEST,
    miss_px,
    pixel_shapes,
    sets,
)

LACKS = {"taglab": {"polyline"}, "coco": {"polyline"}, "biigle": set()}


@pytest.mark.parametrize("backdrops", [BACKDROPS, TILES], ids=["whole", "tiles"])
@pytest.mark.parametrize("name", FORMATS)
@given(some=sets)
@settings(max_examples=15)
def test_what_is_written_is_read_as_it_was(
    name: str, backdrops: Backdrops, some: AnnotationSet
) -> None:
    files = FORMATS[name].write(some, backdrops)
    kept = [one for one in some.annotations if one.shape.kind not in LACKS[name]]
    assert files.written == len(kept)
    assert bool(files.left_out) >= (len(kept) < len(some.annotations))
    back = FORMATS[name].read(files.texts[""].encode(), backdrops)
    if name == "taglab":  # pictures one after the other, in each regions and then points
        assert len(back.annotations) == len(kept)
        pool = list(back.annotations)
        found = [next(b for b in pool if b.id == a.id) for a in kept]
    else:
        found = list(back.annotations)
    for before, after in zip(kept, found, strict=True):
        assert (after.label, after.image, after.shape.kind) == (
            before.label, before.image, before.shape.kind,
        )  # fmt: skip
        assert miss_px(before, after) < 1e-6
        assert after.author == before.author and after.time_utc == before.time_utc
        if name != "biigle":
            assert after.note == before.note and after.id == before.id
            assert dict(after.attributes) == dict(before.attributes)
    if name != "biigle":  # a report names the labels it uses
        assert [label.id for label in back.labels] == [label.id for label in LABELS]
        assert [label.aphia_id for label in back.labels] == [one.aphia_id for one in LABELS]
        assert [label.colour for label in back.labels] == [one.colour for one in LABELS]
    else:
        tree = FORMATS[name].read(files.texts["_labels"].encode(), backdrops)
        assert {label.id for label in LABELS} <= {label.id for label in tree.labels}
        assert tree.by_label["Porites"].aphia_id == 206987
    again, known = some.with_more(back, PIXEL)
    assert known == len(back.annotations) and len(again.annotations) == len(some.annotations)


@given(shape=pixel_shapes(500.0, 400.0, ("polygon",), 1))
def test_slits_keep_the_area_and_are_found_again(shape: DrawnShape) -> None:
    assume(shape.holes)
    ring = joined(shape.points, shape.holes)
    assert ring is not None
    assert abs(signed_area(ring)) == pytest.approx(shape.area, rel=1e-9)
    outer, holes = parted(ring)
    assert outer == shape.points and len(holes) == len(shape.holes)
    assert {frozenset(h) for h in holes} == {frozenset(h) for h in shape.holes}


@given(data=st.data())
def test_masks_are_packed_unpacked_and_outlined_exactly(data: st.DataObject) -> None:
    rows, columns = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24))
    seed = data.draw(st.integers(0, 2**16))
    chosen = np.random.default_rng(seed).random((rows, columns)) < data.draw(st.floats(0, 1))
    mask = chosen.astype(np.uint8)
    runs = encoded(mask)
    assert sum(runs) == mask.size
    assert unpacked(packed(runs)) == runs
    found = decoded(runs, rows, columns)
    if not mask.any():
        assert found is None
        return
    assert found is not None
    whole = np.zeros_like(mask)
    high, wide = found.pixels.shape
    whole[found.top : found.top + high, found.left : found.left + wide] = found.pixels
    np.testing.assert_array_equal(whole, mask)
    polygons = [Polygon(outer, holes) for outer, holes in outlines(found)]
    assert sum(one.area for one in polygons) == pytest.approx(mask.sum(), abs=1e-9)
    drawn = rasterize(polygons, out_shape=mask.shape, transform=GridAffine.identity())
    np.testing.assert_array_equal(drawn, mask)


def test_packed_runs_by_hand() -> None:
    # five bits a character from "0" on, the lowest first, 32 for more, 16 in the last is a sign;
    # from the fourth run on the difference to the run two before
    assert unpacked("061") == [0, 6, 1]
    assert unpacked("T3") == [4 + 3 * 32]
    assert unpacked("061N") == [0, 6, 1, 6 - 2]
    assert packed([0, 6, 1, 4]) == "061N"


COCO_BY_HAND = {
    "images": [{"id": 7, "file_name": "survey/left/000.png", "width": 564, "height": 451}],
    "categories": [
        {"id": 1, "name": "urchin", "supercategory": "animal"},
        {"id": 2, "name": "weed", "supercategory": "none"},
    ],
    "annotations": [
        {"id": 1, "image_id": 7, "category_id": 1, "segmentation": [[10, 10, 30, 10, 30, 20]],
         "bbox": [10, 10, 20, 10], "area": 100, "iscrowd": 0},
        {"id": 2, "image_id": 7, "category_id": 2, "iscrowd": 1, "bbox": [1, 0, 1, 3],
         "segmentation": {"size": [451, 564], "counts": [451, 3, 564 * 451 - 454]}},
        {"id": 3, "image_id": 7, "category_id": 2, "bbox": [5, 6, 7, 8], "score": 0.5},
        {"id": 4, "image_id": 7, "category_id": 1, "keypoints": [3, 4, 2, 0, 0, 0],
         "bbox": [3, 4, 0, 0], "attributes": {"occluded": True}},
        {"id": 5, "image_id": 7, "category_id": 1, "bbox": [0, 0, 9, 9],
         "segmentation": [[0, 0, 4, 0, 4, 4, 0, 4], [5, 5, 9, 5, 9, 9, 5, 9]]},
    ],
}  # fmt: skip


def test_a_coco_file_by_hand() -> None:
    found = FORMATS["coco"].read(json.dumps(COCO_BY_HAND).encode(), BACKDROPS)
    triangle, column, box, spot, first, second = found.annotations
    assert [label.id for label in found.labels] == ["animal > urchin", "weed"]
    assert all(one.image == "left/000.png" for one in found.annotations)
    assert triangle.shape.area == 100.0 and triangle.label == "animal > urchin"
    assert column.shape.geometry.bounds == (1.0, 0.0, 2.0, 3.0)
    assert column.attributes == {"iscrowd": True}
    assert box.shape.kind == "rectangle" and box.shape.area == 56.0
    assert box.attributes == {"score": 0.5}
    assert spot.shape.points == ((3.0, 4.0),) and spot.attributes == {"occluded": True}
    assert first.attributes == second.attributes == {"instance": "coco 5"}
    assert first.shape.area == second.shape.area == 16.0


TAGLAB_BY_HAND = {
    "filename": "reef.json",
    "working_area": None,
    "dictionary_name": "reef",
    "dictionary_description": "",
    "labels": {
        "Empty": {"id": "Empty", "name": "Empty", "description": None, "fill": [0, 0, 0],
                  "border": [200, 200, 200], "visible": True},
        "Pocillopora": {"id": "Pocillopora", "name": "Pocillopora", "description": "AphiaID 206938",
                        "fill": [255, 0, 128], "border": [200, 200, 200], "visible": True},
    },
    "images": [{
        "rect": [0.0, 0.0, 0.0, 0.0], "map_px_to_mm_factor": "2.7", "width": 1020, "height": 1035,
        "annotations": {
            "regions": [{
                "bbox": [9, 9, 21, 21], "centroid": [19.5, 19.5], "area": 300.0, "perimeter": 80.0,
                "contour": "95 95 200 0 0 200 -200 0",
                "inner contours": ["145 145 100 0 0 100 -100 0"], "instance name": "coral3",
                "blob name": "c-3-19.5x-19.5y", "class name": "Pocillopora", "id": 3,
                "note": "bleached", "data": {"dead": 20},
            }, {
                "bbox": [1, 1, 2, 2], "centroid": [1, 1], "area": 2.0, "perimeter": 6.8,
                "contour": [[0, 0], [2, 0], [0, 2]], "inner contours": [], "class name": "Empty",
                "instance name": "coral4", "blob name": "c-4-1.0x-1.0y", "id": 4,
                "note": "", "data": {},
            }],
            "points": [{"X": 100.0, "Y": 50.0, "Class": "Sponge", "Id": 1, "Note": "", "Data": {}}],
        },
        "layers": [], "channels": [{"filename": "maps/mosaic.png", "type": "RGB"}],
        "id": "reef 2023", "name": "reef 2023", "workspace": [], "export_dataset_area": [],
        "acquisition_date": "2023-05-01", "georef_filename": "", "metadata": {},
    }],
    "correspondences": {}, "spatial_reference_system": None, "metadata": {},
    "image_metadata_template": {},
}  # fmt: skip


TAGLAB_ASKS = {
    "bbox", "centroid", "area", "perimeter", "contour", "inner contours", "class name",
    "instance name", "blob name", "id", "note",
}  # fmt: skip
"""What TagLab takes from every region when it opens a project."""


def test_a_taglab_project_has_what_taglab_asks_for() -> None:
    values = FORMATS["taglab"].read(json.dumps(TAGLAB_BY_HAND).encode(), BACKDROPS)
    whole = json.loads(FORMATS["taglab"].write(values, BACKDROPS).texts[""])
    assert {key: label["id"] for key, label in whole["labels"].items()} == {
        label.id: label.id for label in values.labels
    }
    marks = whole["images"][0]["annotations"]
    assert len(marks["regions"]) == 2
    assert all(region.keys() >= TAGLAB_ASKS for region in marks["regions"])
    assert all(point.keys() >= {"Id", "X", "Y", "Class", "Note"} for point in marks["points"])


@pytest.mark.parametrize("old", [False, True], ids=["2023", "older"])
def test_a_taglab_project_by_hand(old: bool) -> None:
    whole = json.loads(json.dumps(TAGLAB_BY_HAND))
    if old:  # a list of labels, regions alone
        whole["labels"] = list(whole["labels"].values())
        whole["images"][0]["annotations"] = whole["images"][0]["annotations"]["regions"]
    found = FORMATS["taglab"].read(json.dumps(whole).encode(), BACKDROPS)
    assert len(found.annotations) == (2 if old else 3)
    colony, nameless = found.annotations[:2]
    assert found.by_label["Pocillopora"].aphia_id == 206938
    assert found.by_label["Pocillopora"].colour == "#ff0080"
    assert colony.image is None and colony.shape.area == pytest.approx(300 * PIXEL**2)
    assert min(x for x, _ in colony.shape.points) == pytest.approx(WEST + 10 * PIXEL)
    assert colony.note == "bleached" and colony.attributes == {"dead": 20}
    assert nameless.label == "Empty"
    if not old:
        assert found.annotations[2].label == "Sponge"
        assert found.annotations[2].shape.points[0][0] == pytest.approx(WEST + 100 * PIXEL)


BIIGLE_BY_HAND = """\
annotation_label_id,label_id,label_name,label_hierarchy,user_id,firstname,lastname,image_id,\
filename,image_longitude,image_latitude,shape_id,shape_name,points,attributes,annotation_id,\
created_at
1,10,Porifera,Animalia > Porifera,2,Ada,Lovelace,5,tile_000_001.png,,,4,Circle,"[100,50.5,9]",\
"{""width"":512,""height"":512}",77,"2023-04-05 06:07:08"
2,11,Litter,Litter,2,Ada,Lovelace,5,tile_000_001.png,,,5,Rectangle,"[1,1,5,1,5,3,1,3]",,78,
3,11,Litter,Litter,2,Ada,Lovelace,6,000.png,,,3,Polygon,"[1,1,5,1,5,3,1,1]",,79,
4,11,Litter,Litter,2,Ada,Lovelace,6,000.png,,,6,Ellipse,"[10,20,30,20,20,15,20,25]",,80,
5,11,Litter,Litter,2,Ada,Lovelace,6,000.png,,,2,LineString,"[1,1,5,1,5,3]",,81,
6,11,Litter,Litter,2,Ada,Lovelace,6,000.png,,,7,WholeFrame,[],,82,
"""


def test_a_biigle_report_of_tiles_by_hand() -> None:
    found = FORMATS["biigle"].read(BIIGLE_BY_HAND.encode(), TILES)
    circle, box, triangle, ellipse, line = found.annotations
    assert circle.label == "Animalia > Porifera" and circle.author == "Ada Lovelace"
    assert circle.time_utc == "2023-04-05T06:07:08Z"
    assert circle.image is None and circle.shape.radius == pytest.approx(9 * PIXEL)
    assert circle.shape.points[0][0] == pytest.approx(WEST + (384 + 100) * PIXEL)
    assert box.shape.kind == "rectangle"
    assert triangle.image == "left/000.png" and len(triangle.shape.points) == 3
    assert ellipse.shape.area == pytest.approx(np.pi * 10 * 5, rel=2e-3)
    assert ellipse.shape.geometry.bounds == pytest.approx((10, 15, 30, 25))
    assert line.shape.kind == "polyline"


def test_a_label_tree_and_a_list_of_species() -> None:
    tree = "id,name,parent_id,color,label_source_id,source_id\n1,Animalia,,00ff00,,2\n" \
        "2,Porifera,1,0000FF,1,558\n"  # fmt: skip
    found = FORMATS["biigle"].read(tree.encode(), BACKDROPS)
    assert [(one.id, one.aphia_id, one.colour) for one in found.labels] == [
        ("Animalia", 2, "#00ff00"), ("Animalia > Porifera", 558, "#0000ff"),
    ]  # fmt: skip
    plain = FORMATS["biigle"].read(b"name,aphia_id\nSabella,129964\nSepia,\n", BACKDROPS)
    assert [(one.id, one.aphia_id) for one in plain.labels] == [
        ("Sabella", 129964),
        ("Sepia", None),
    ]
    assert plain.labels[0].code != plain.labels[1].code


@pytest.mark.parametrize("name", FORMATS)
@given(noise=st.binary(max_size=60))
@settings(max_examples=30)
def test_anything_else_is_one_line(name: str, noise: bytes) -> None:
    try:
        FORMATS[name].read(noise, BACKDROPS)
    except AliceError as error:
        assert len(str(error).splitlines()) == 1


junk = st.one_of(
    st.none(), st.integers(), st.floats(), st.text(max_size=3), st.lists(st.integers(), max_size=3),
    st.just({}), st.just([{}]), st.just([["a"]]), st.just(10**30),
)  # fmt: skip


@pytest.mark.parametrize("name", ["coco", "taglab"])
@given(data=st.data(), value=junk)
@settings(max_examples=150)
def test_a_file_with_one_wrong_value_is_read_or_one_line(
    name: str, data: st.DataObject, value: object
) -> None:
    whole = json.loads(json.dumps(COCO_BY_HAND if name == "coco" else TAGLAB_BY_HAND))
    at, key = data.draw(st.sampled_from(list(_places(whole))))
    at[key] = value
    try:
        found = FORMATS[name].read(json.dumps(whole).encode(), BACKDROPS)
    except AliceError as error:
        assert len(str(error).splitlines()) == 1 and len(str(error)) < 600
    else:
        assert all(np.isfinite(one.shape.area) for one in found.annotations)


def _places(node: object) -> list[tuple[Any, Any]]:
    keys = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    found = []
    for key, inner in list(keys):
        found.append((node, key))
        found.extend(_places(inner))
    return found


@given(data=st.data(), text=st.text(max_size=8))
@settings(max_examples=100)
def test_a_report_with_one_wrong_cell_is_read_or_one_line(data: st.DataObject, text: str) -> None:
    rows = list(csv.reader(io.StringIO(BIIGLE_BY_HAND)))
    row = data.draw(st.integers(1, len(rows) - 1))
    rows[row][data.draw(st.integers(0, len(rows[0]) - 1))] = text
    out = io.StringIO()
    csv.writer(out).writerows(rows)
    try:
        FORMATS["biigle"].read(out.getvalue().encode("utf-8", "replace"), TILES)
    except AliceError as error:
        assert len(str(error).splitlines()) == 1


def test_a_smaller_copy_and_an_ambiguous_name_are_refused() -> None:
    whole = json.loads(json.dumps(COCO_BY_HAND))
    whole["annotations"] = whole["annotations"][:1]
    whole["images"][0] |= {"width": 282, "height": 226}
    with pytest.raises(AliceError, match="282"):
        FORMATS["coco"].read(json.dumps(whole).encode(), BACKDROPS)
    whole["images"][0] |= {"width": 564, "height": 451, "file_name": "000.png"}
    with pytest.raises(AliceError, match=r"left/000\.png"):
        FORMATS["coco"].read(json.dumps(whole).encode(), BACKDROPS)
