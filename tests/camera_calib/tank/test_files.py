from pathlib import Path

import numpy as np
import pytest

from alice_survey.base.errors import CalibrationError
from camera_calib.tank.files import read_detections, read_reference, warn_of_left_out

POINTS = """/* corners // of the tank */
[
  {"camera": {"x": 10, "y": 20.5}, // "quoted"
   "world": {"x": 0.0, "y": 0.0, "z": 0.0 /* cm */}},
  {"camera": {"x": 30, "y": 20}, "world": {"x": 38.7, "y": 0, "z": 0}, "note": "/* kept */ //"},
  {"camera": {"x": 30, "y": 40}, "world": {"x": 38.7, "y": 20.8, "z": 0}},
  {"camera": {"x": 10, "y": 40}, "world": {"x": 0, "y": 20.8, "z": 0}}
]
"""
CAMERAS = ("cam1", "cam2", "cam3")


def written(folder: Path, text: str, name: str = "cam1_references.json") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(("unit", "scale"), [("cm", 0.01), ("m", 1.0), ("mm", 0.001)])
def test_reference_points_with_comments(tmp_path: Path, unit: str, scale: float) -> None:
    reference = read_reference(written(tmp_path, POINTS), unit)

    assert reference.camera == "cam1"
    np.testing.assert_allclose(reference.pixels[0], [10.5, 21.0])
    np.testing.assert_allclose(reference.points_world[2], np.array([38.7, 20.8, 0.0]) * scale)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[1, 2", "Expecting"),
        ('[{"camera": {"x": 1, "y": 2}}]', "lacks 'world'"),
        ('[{"camera": {"x": 1}, "world": {"x": 0, "y": 0, "z": 0}}]', "lacks 'y'"),
        ('{"a": 1}', "a list of"),
        ('[{"camera": {"x": "a", "y": 2}, "world": {"x": 0, "y": 0, "z": 0}}]', "could not"),
        ("[]", "0 reference points"),
        (POINTS.replace("20.5", "NaN"), "not a number"),
    ],
)
def test_wrong_reference_files_are_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(CalibrationError, match=says) as error:
        read_reference(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_missing_reference_file_and_unit(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"cam9\.json: cannot be read"):
        read_reference(tmp_path / "cam9.json")
    with pytest.raises(CalibrationError, match="unit 'inch'"):
        read_reference(written(tmp_path, POINTS), "inch")


def table(folder: Path, *rows: str, header: str = ",cam,frame,id,x,y") -> Path:
    return written(folder, "\n".join([header, *rows]) + "\n", "detections.csv")


def test_detections_pair_by_frame_and_id(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "0,1,7,0,10,20",
        "1,2.0,7.0,0.0,30,40",
        "2,cam3,7,0,50,60",
        "3,2,7,1,31,41",
        "4,1,7,1,11,21",
        "5,2,8,0,1,1",
    )

    found = read_detections(path, CAMERAS)

    assert found.frames.tolist() == [7, 7] and found.ids.tolist() == [0, 1]
    np.testing.assert_allclose(found.pixels[:, 0], [[10.5, 20.5], [30.5, 40.5], [50.5, 60.5]])
    np.testing.assert_allclose(found.pixels[:, 1], [[11.5, 21.5], [31.5, 41.5], [np.nan] * 2])
    assert (found.alone, found.not_numbers, found.doubled) == (1, 0, 0)
    assert found.candidates.tolist() == [1, 1]


def test_a_thing_seen_twice_makes_a_point_each(tmp_path: Path) -> None:
    path = table(
        tmp_path, "0,1,3,0,10,20", "1,1,3,0,99,99", "2,2,3,0,30,40", "3,2,3,0,32,42", "4,3,3,0,5,6"
    )

    found = read_detections(path, CAMERAS)

    np.testing.assert_allclose(found.pixels[0], [[10.5, 20.5]] * 2)
    np.testing.assert_allclose(found.pixels[1], [[30.5, 40.5], [32.5, 42.5]])
    assert found.candidates.tolist() == [2, 2] and found.doubled == 1


def test_frame_offsets_shift_a_clock(tmp_path: Path) -> None:
    path = table(tmp_path, "0,1,3,0,10,20", "1,2,5,0,30,40")

    found = read_detections(path, ("cam1", "cam2"), {"cam2": -2})

    assert found.frames.tolist() == [3]
    with pytest.raises(CalibrationError, match="frame offset of cam9"):
        read_detections(path, ("cam1", "cam2"), {"cam9": 1})


def test_what_is_left_out_is_counted_in_one_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = table(
        tmp_path,
        "0,1,1,0,1,2",
        "1,2,1,0,1,2",
        "2,1,2,0,1,2",
        "3,1,3,0,nan,2",
        "4,2,3,0,1,",
        "5,1,1,0,5,5",
    )

    warn_of_left_out(path, read_detections(path, ("cam1", "cam2")))

    assert capsys.readouterr().err == (
        f"warning: {path}: detections left out: 1 have no partner in another camera, 2 hold a "
        "pixel that is not a number, 1 repeat a frame and id of the first camera\n"
    )


def test_nothing_left_out_is_no_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path, "0,1,1,0,1,2", "1,2,1,0,1,2")
    warn_of_left_out(path, read_detections(path, ("cam1", "cam2")))
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("rows", "header", "says"),
    [
        (["0,1,1,0,1,2"], ",cam,frame,id,x", "lacks the column y"),
        (["0,9,1,0,1,2"], ",cam,frame,id,x,y", "line 2: camera '9' has no reference file"),
        (["0,1,1.5,0,1,2"], ",cam,frame,id,x,y", "line 2: '1.5' is no whole number"),
        (["0,1,1,0,1,2", "0,2,1,0,a,2"], ",cam,frame,id,x,y", "line 3: could not convert"),
        (
            ["0,1,1,0,1,2", "0,2,2,0,1,2"],
            ",cam,frame,id,x,y",
            "no frame and id was detected by two",
        ),
        ([], ",cam,frame,id,x,y", "no frame and id"),
    ],
)
def test_wrong_detections_are_one_line(
    tmp_path: Path, rows: list[str], header: str, says: str
) -> None:
    path = table(tmp_path, *rows, header=header)
    with pytest.raises(CalibrationError, match=says) as error:
        read_detections(path, ("cam1", "cam2"))
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_missing_detections_are_told(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.csv: cannot be read"):
        read_detections(tmp_path / "none.csv", CAMERAS)


def test_reference_points_nested_without_end(tmp_path: Path) -> None:
    path = written(tmp_path, "[" * 100_000)
    with pytest.raises(CalibrationError, match="recursion"):
        read_reference(path)
