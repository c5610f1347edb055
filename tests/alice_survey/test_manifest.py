"""Manifests that a person edited, or that a disk damaged."""

from pathlib import Path

import pytest

from alice_survey.base.errors import ImageError
from alice_survey.base.manifest import read_manifest

HEAD = "image,camera,station,mask,time_s\n"


def test_a_byte_order_mark_is_no_part_of_a_name(tmp_path: Path) -> None:
    path = tmp_path / "manifest.csv"
    path.write_bytes(b"\xef\xbb\xbf" + HEAD.encode() + b"a.png,left,0,,1.5\n")
    assert read_manifest(path)[0].image == "a.png"


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("a.png,left,1e3,,0", "station is '1e3', not a number"),
        (f"a.png,left,{'9' * 25},,0", "too large"),
        (f"a.png,left,{'9' * 400},,0", "too large|not a number"),
        (f"a.png,left,{'9' * 5000},,0", "not a number"),
        ("a.png,left,0,,1e300", "too large"),
        ("a.png,left,0,,inf", "too large"),
        ("../a.png,left,0,,0", "leaves its folder"),
        ("/a.png,left,0,,0", "leaves its folder"),
        ("a.png,left,0,../m.png,0", "leaves its folder"),
        ("a\0.png,left,0,,0", "not a file name|NUL"),
        ("a\x1b.png,left,0,,0", "not a file name"),
        ("x" * 200_000 + ",left,0,,0", "no CSV text"),
    ],
)  # fmt: skip
def test_wrong_rows_are_one_line(row: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "manifest.csv"
    path.write_text(HEAD + row + "\n")
    with pytest.raises(ImageError, match=told) as fault:
        read_manifest(path)
    assert "\n" not in str(fault.value)
    assert len(str(fault.value)) < 400


def test_what_is_no_text_is_said(tmp_path: Path) -> None:
    path = tmp_path / "manifest.csv"
    path.write_bytes(HEAD.encode() + b"\xff\xfe,left,0,,0\n")
    with pytest.raises(ImageError, match="UTF-8"):
        read_manifest(path)
