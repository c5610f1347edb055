"""Tables of picks and control are changed row by row, and by one writer at a time."""

from pathlib import Path

import pytest

from alice_survey.core.artefacts import StaleError
from alice_survey.core.errors import WorkspaceError
from reconstruct.placing.control_points import (
    Pick,
    read_control,
    read_picks,
    save_control,
    save_picks,
    table_token,
)


def pick(image: str, point: str, x: float = 10.0, y: float = 20.0, **more: object) -> Pick:
    values = {"sigma_px": 0.3, "matched_to": "", **more}
    return Pick(image=image, point=point, x_px=x + 0.5, y_px=y + 0.5, **values)  # type: ignore[arg-type]


def test_other_rows_comments_and_columns_stay_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    kept = (
        "# seen by Ada, at noon\r\n"
        'left/a.png, p1 ,1.50,2,0.5,"said ""maybe"", twice"\r\n'
        "left/b.png,p2,,,,to look for\r\n"
    )
    path.write_bytes(
        ("image,point,x,y,sigma_px,note\r\n" + kept + "left/b.png,p2,5,6,,mine\r\n").encode()
    )

    save_picks(
        path, table_token(path),
        [pick("left/b.png", "p2", 7.25, 8.0), pick("right/b.png", "p2", matched_to="left/b.png")],
        {"p2"},
    )  # fmt: skip

    text = path.read_bytes().decode()
    head, rest = text.split("\r\n", 1)
    assert head == "image,point,x,y,sigma_px,note,matched_to"
    assert rest == (
        kept.replace("left/b.png,p2,,,,to look for\r\n", "")
        + "left/b.png,p2,7.2500,8.0000,0.3000,to look for,\r\n"
        + "right/b.png,p2,10.0000,20.0000,0.3000,,left/b.png\r\n"
    )
    found = {(p.image, p.point): p for p in read_picks(path)}
    assert found["left/b.png", "p2"].x_px == 7.75
    assert found["right/b.png", "p2"].matched_to == "left/b.png"
    assert found["left/a.png", "p1"].x_px == 2.0 and len(found) == 3


def test_of_two_writers_the_second_is_told(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    token = save_picks(path, "", [pick("a.png", "p")], {"p"})
    before = path.read_bytes()

    with pytest.raises(StaleError):
        save_picks(path, "", [pick("b.png", "q")], {"q"})
    assert path.read_bytes() == before

    save_picks(path, token, [pick("b.png", "q")], {"q"})
    assert {p.point for p in read_picks(path)} == {"p", "q"}


def test_a_wrong_table_is_left_alone_and_its_line_named(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    path.write_text("image,point,x,y\na.png,p,1,2\na.png,q,one,2\n")
    before = path.read_bytes()
    with pytest.raises(WorkspaceError, match="line 3"):
        save_picks(path, table_token(path), [pick("b.png", "p")], {"p"})
    assert path.read_bytes() == before


def test_control_rows_are_replaced_by_kind_and_name(tmp_path: Path) -> None:
    path = tmp_path / "control.csv"
    point = {"kind": "point", "name": "1", "use": "control", "north_m": "1", "east_m": "2",
             "depth_m": "9", "sigma_m": "0.01"}  # fmt: skip
    bar = {"kind": "bar", "name": "1", "use": "check", "from": "1", "to": "2", "length_m": "0.5",
           "sigma_m": "0.001"}  # fmt: skip
    token = save_control(path, "", [point, bar], [])
    token = save_control(path, token, [{**point, "depth_m": "10"}], [("point", "1")])
    known = read_control(path)
    assert known.points[0].depth_m == 10.0 and known.lengths[0].length_m == 0.5
    save_control(path, token, [], [("point", "1")])
    assert read_control(path).points == () and len(read_control(path).lengths) == 1
