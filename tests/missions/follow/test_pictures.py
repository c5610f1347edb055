import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from alice_survey.core.frames import Array
from missions.follow.rows import ALTITUDE, DEPTH, HEADING, LATITUDE, ROLL, Piece, SteadyTimes
from missions.follow.tail import NavigationTail
from tests.missions.follow.dives import PLAN, Followed, at_once, route_rows, same, text_of


@st.composite
def logs(draw: st.DrawFn) -> tuple[Array, list[int]]:
    """Rows of a dive with all that logs may lack, and where their text is cut."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    interval_s = draw(st.sampled_from([0.3, 0.5, 1.0, 2.4]))
    rows = route_rows(PLAN, interval_s, rng, draw(st.sampled_from([0.0, 0.05, 0.3])))
    rows[:, 0] += rng.uniform(0, draw(st.sampled_from([0.0, 0.3])) * interval_s, len(rows))
    for _ in range(draw(st.integers(0, 2))):  # gaps of all lengths
        first = int(rng.integers(1, len(rows) - 1))
        rows = np.delete(
            rows, slice(first, first + int(rng.integers(1, int(40 / interval_s)))), axis=0
        )
    for column in draw(st.lists(st.sampled_from([DEPTH, ROLL, HEADING, ALTITUDE]), max_size=2)):
        how = draw(st.sampled_from(["none", "rare", "from", "until"]))
        lost = {
            "none": np.ones(len(rows), bool), "rare": np.arange(len(rows)) % 7 > 0,
            "from": np.arange(len(rows)) > len(rows) // 2,
            "until": np.arange(len(rows)) < len(rows) // 2,
        }[how]  # fmt: skip
        rows[lost, column] = np.nan
    rows[rng.random(len(rows)) < draw(st.sampled_from([0.0, 0.2])), LATITUDE] = np.nan
    if draw(st.booleans()):  # off its lines for a while, and high up at the end
        middle = len(rows) // 2
        rows[middle : middle + 15, LATITUDE] += 2e-5
        rows[-len(rows) // 5 :, ALTITUDE] += 4.0
    if np.isnan(rows[:, [DEPTH, ALTITUDE]]).all(axis=1).mean() > 0.3:
        rows[:, DEPTH] = PLAN.seafloor_depth_m - PLAN.altitude_m
    assert np.isfinite(rows[:, LATITUDE]).sum() > 5
    cuts = draw(st.lists(st.floats(0, 1), max_size=8))
    return rows, [round(cut * len(text_of(rows))) for cut in cuts]


@settings(max_examples=60, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])  # fmt: skip
@given(logs())
def test_a_log_read_as_it_grows_gives_what_it_gives_at_once(
    tmp_path: Path, log: tuple[Array, list[int]]
) -> None:
    rows, cuts = log
    text, path = text_of(rows), tmp_path / "nav.csv"
    path.unlink(missing_ok=True)
    tail, followed, wall_s = NavigationTail(path), Followed(), 0.0
    times = SteadyTimes(tail.left_out)
    assert tail.poll(0.0) == []  # it is not there yet
    for first, last in itertools.pairwise([0, *sorted(cuts), len(text)]):
        with path.open("ab") as file:
            file.write(text[first:last])
        for piece in tail.poll(wall_s):
            followed.take(times.passed(piece))
        followed.certificate()  # it changes nothing to look
    tail.close()

    same(followed.certificate(), at_once(path))


def test_pictures_are_counted_while_the_log_grows(tmp_path: Path) -> None:
    rows = route_rows(PLAN, 0.5, np.random.default_rng(1))
    followed = Followed()
    seen = []
    for part in np.array_split(rows, 40):
        followed.take([Piece(rows=part)])
        seen.append(followed.coverage.stations)
    assert followed.again == 0
    # Never more than some seconds behind.
    expected = (np.cumsum([len(p) for p in np.array_split(rows, 40)]) - 1) * 0.5 / PLAN.interval_s
    assert np.all(expected - np.array(seen) < 4)
    assert np.all(expected - np.array(seen) > -2)
    assert 0.99 < followed.coverage.covered_share <= 1.0


def test_a_file_that_is_replaced_or_begun_again_goes_on(tmp_path: Path) -> None:
    rows = route_rows(PLAN, 0.5, np.random.default_rng(2))
    path, followed = tmp_path / "nav.csv", Followed()
    tail = NavigationTail(path)
    times = SteadyTimes(tail.left_out)

    def read() -> list[Piece]:
        pieces = [p for _ in range(3) for piece in tail.poll(0.0) for p in times.passed(piece)]
        followed.take(pieces)
        return pieces

    third = len(rows) // 3
    path.write_bytes(text_of(rows[:third]) + b"100.5,32.8,34")  # half a line
    read()
    (tmp_path / "new.csv").write_bytes(text_of(rows[third : 2 * third]))
    (tmp_path / "new.csv").rename(path)
    assert any(piece.starts for piece in read())
    # Cut to nothing and begun again, by then longer than it was; its clock counts from 0 again.
    last = rows[2 * third :].copy()
    last[:, 0] -= last[0, 0]
    path.write_bytes(text_of(last))
    assert any(piece.starts for piece in read())
    tail.close()

    assert sum(count for what, count in tail.left_out.items() if "half" in what) == 1
    whole = tmp_path / "whole.csv"
    whole.write_bytes(text_of(rows))
    seen, all_of_it = followed.certificate(), at_once(whole)
    # Two pictures fewer at the seams, of a phase of their own.
    assert 0 <= all_of_it.stations - seen.stations <= 6
    assert seen.covered_share > 0.98 * all_of_it.covered_share


def test_times_that_repeat_or_jump_are_left_out_and_a_clock_that_was_set_is_followed() -> None:
    rows = route_rows(PLAN, 0.5, np.random.default_rng(3))[:100]
    left_out: Counter[str] = Counter()
    times = SteadyTimes(left_out)
    wild = rows[50].copy()
    wild[0] += 5e5
    late = rows[30]
    mixed = np.concatenate([rows[:51], [wild], rows[50:51], [late], rows[51:60]])
    kept = times.passed(Piece(rows=mixed))
    assert [piece.starts for piece in kept] == [False]
    np.testing.assert_array_equal(kept[0].rows, rows[:60])
    assert sum(left_out.values()) == 3
    # Set back by an hour: after ten rows it is believed, and none of these is lost.
    back = rows[60:].copy()
    back[:, 0] -= 3600.0
    pieces = [p for row in back for p in times.passed(Piece(rows=row[None]))]
    assert next(piece.starts for piece in pieces if len(piece.rows))
    np.testing.assert_array_equal(np.concatenate([p.rows for p in pieces]), back)


@pytest.mark.parametrize("interval_s", [0.7, 1.3])
def test_what_a_slow_log_makes_of_gaps_is_decided_on_again(
    tmp_path: Path, interval_s: float
) -> None:
    """Its first rows come fast, so that 4 s are a gap at first, and none in the end."""
    rows = route_rows(PLAN, interval_s, np.random.default_rng(4))
    fast = route_rows(PLAN, 0.1, np.random.default_rng(4))
    begin = fast[fast[:, 0] < 104.0]
    rows = np.concatenate([begin, rows[rows[:, 0] > 108.0]])
    path = tmp_path / "nav.csv"
    path.write_bytes(text_of(rows))
    tail, followed = NavigationTail(path), Followed()
    for part in np.array_split(tail.poll(0.0)[0].rows, 30):
        followed.take([Piece(rows=part)])
    tail.close()
    assert followed.again == (1 if 5 * interval_s > 4.0 else 0)
    same(followed.certificate(), at_once(path))
