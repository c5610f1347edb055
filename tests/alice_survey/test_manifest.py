"""Manifests that a person edited, or that a disk damaged."""

from pathlib import Path

import pytest

from alice_survey.core.errors import ImageError
from alice_survey.core.manifest import read_manifest, stored_name
from tests.refusals import refused

HEAD = "image,camera,station,mask,time_s\n"


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    path = tmp_path / "manifest.csv"
    path.write_bytes(b"\xef\xbb\xbf" + HEAD.encode() + b"a.png,left,0,,1.5\n")
    assert read_manifest(path)[0].image == "a.png"


@pytest.mark.parametrize(
    "row",
    [
        "a.png,left,1e3,,0", "a.png,left,0,,soon", "a.png,left,,,0", "../a.png,left,0,,0",
        "/a.png,left,0,,0", "a.png,left,0,../m.png,0", "x" * 200_000 + ",left,0,,0",
        "a.png,left,0,,0\na.png,left,0,,0", "\udcff,left,0,,0",
    ],
    ids=lambda row: ascii(row[:12]),
)  # fmt: skip
def test_wrong_rows_are_one_line(row: str, tmp_path: Path) -> None:
    path = tmp_path / "manifest.csv"
    path.write_text(f"{HEAD}{row}\n", encoding="utf-8", errors="surrogateescape")
    with refused(ImageError, path) as fault:
        read_manifest(path)
    assert len(str(fault.value)) < 400


def test_a_name_in_another_case_is_that_of_the_one_picture_which_it_fits() -> None:
    images = ["left/a.png", "left/A.png", "left/IMG_1.JPG"]
    asked = ["left/a.png", "Left/img_1.jpg", "left/img_1.png", "LEFT/A.PNG"]
    found = ["left/a.png", "left/IMG_1.JPG", "left/img_1.png", "LEFT/A.PNG"]
    assert [stored_name(image, images) for image in asked] == found
