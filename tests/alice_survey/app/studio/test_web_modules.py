"""Pure functions of the studio's tabs, run with node: shapes, undo, requests, words."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

import alice_survey.app.studio
from tests.alice_survey.kit.node import run_modules

WEB = Path(alice_survey.app.studio.__file__).with_name("web")
SQUARE: dict[str, Any] = {
    "outer": [[0, 0], [10, 0], [10, 8], [0, 8]],
    "holes": [[[2, 2], [4, 2], [4, 4], [2, 4]]],
}
LINE = [[0.0, 0.0], [3.0, 4.0], [3.0, 10.0]]
SHAPES = {"survey": [SQUARE], "no_go": [], "allowed": [], "corridors": [LINE]}
OUTER = {"kind": "survey", "index": 0, "ring": 0}
HOLE = {"kind": "survey", "index": 0, "ring": 1}
WAY = {"kind": "corridors", "index": 0, "ring": 0}


def run(folder: Path, module: str, expression: str, **values: Any) -> Any:
    """The value of an expression of JavaScript; `m` is a module, and values are named."""
    lines = [f'import * as m from "./{module}.js";']
    lines += [f"const {name} = {json.dumps(value)};" for name, value in values.items()]
    lines.append(f"console.log(JSON.stringify(await ({expression})));")
    return run_modules(WEB, folder, "\n".join(lines))


def test_rings_move_and_vertices_come_and_go(tmp_path: Path) -> None:
    """Rings move alone or with their holes; the last vertices take their ring with them."""
    moved, hole, way, more, fewer, no_hole, nothing, no_way = run(
        tmp_path, "plan_shapes",
        """(() => {
          const more = m.insertVertex(s, outer, 3);
          const hole3 = m.removeVertex(s, hole, 0);
          const way2 = m.removeVertex(s, way, 1);
          return [m.moveRing(s, outer, 1, 2), m.moveRing(s, hole, 1, 2),
                  m.moveRing(s, way, -1, 0.5), more, m.removeVertex(more, outer, 4),
                  m.removeVertex(hole3, hole, 0), m.removeRing(s, outer),
                  m.removeVertex(way2, way, 0)];
        })()""",
        s=SHAPES, outer=OUTER, hole=HOLE, way=WAY,
    )  # fmt: skip
    further = [[3, 4], [5, 4], [5, 6], [3, 6]]
    assert moved["survey"][0]["outer"][2] == [11, 10]
    assert moved["survey"][0]["holes"] == [further] and moved["corridors"] == [LINE]
    assert hole["survey"][0] == {"outer": SQUARE["outer"], "holes": [further]}
    assert way["corridors"] == [[[-1, 0.5], [2, 4.5], [2, 10.5]]]
    assert more["survey"][0]["outer"] == [*SQUARE["outer"], [0, 4]]
    assert fewer == SHAPES and nothing == {**SHAPES, "survey": []}
    assert no_hole["survey"] == [{"outer": SQUARE["outer"], "holes": []}]
    assert no_way["corridors"] == []


def test_areas_agree_with_shapely_and_files_replace_what_is_of_their_kind(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 11))
    star = rng.uniform(2, 9, 11)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    imported = {"survey": [], "no_go": [SQUARE], "corridors": [LINE]}
    area, size, zones, kept = run(
        tmp_path, "plan_shapes",
        "[m.areaOf(p), m.sizeOf(s, way), m.withImported(s, i), m.withImported(s, {allowed: [a]})]",
        p=star.tolist(), s=SHAPES, way=WAY, i=imported, a=SQUARE,
    )  # fmt: skip
    assert area == pytest.approx(Polygon(star).area, rel=1e-12)
    assert "11.0 m" in size
    assert zones == {"survey": [], "no_go": [SQUARE], "allowed": [], "corridors": [LINE]}
    assert kept == {**SHAPES, "allowed": [SQUARE]}


def test_the_station_at_a_place_is_the_nearest(tmp_path: Path) -> None:
    """Of all stations of all lines; none where none is within reach."""
    rng = np.random.default_rng(5)
    ends = rng.uniform(-20, 20, (6, 2, 2))
    lines = [{"from": a, "to": b, "stations": 401} for a, b in ends.tolist()]
    places = rng.uniform(-20, 20, (60, 2))
    found = run(
        tmp_path, "plan_stations",
        "q.map((x) => m.nearestStation(lines, x, 3))"
        ".map((f) => f && [lines.indexOf(f.line), f.station])", lines=lines, q=places.tolist(),
    )  # fmt: skip
    share = np.linspace(0, 1, 401)[:, None]
    stations = np.array([a + share * (b - a) for a, b in ends])
    away = np.linalg.norm(stations - places[:, None, None], axis=-1)
    for one, place in zip(found, away, strict=True):
        if one is None:
            assert place.min() > 3 - 0.1
        else:
            assert place[tuple(one)] == pytest.approx(place.min(), abs=1e-2)
    assert 10 < sum(one is None for one in found) < 50


edits = st.lists(
    st.tuples(st.sampled_from(["move", "insert", "remove", "drop", "shift", "add", "hole"]),
              st.integers(0, 40), st.integers(0, 40), st.floats(-5, 5)), max_size=30,
)  # fmt: skip


@settings(max_examples=12, deadline=None)
@given(edits=edits)
def test_undoing_all_of_random_edits_returns_to_the_start(
    edits: list[tuple[str, int, int, float]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """And every state on the way has rings of enough points, to a millimetre."""
    start, end, again, states = run(
        tmp_path_factory.mktemp("undo"), "plan_shapes",
        """(async () => {
          const h = await import("./undo.js");
          let history = h.startHistory({changes: {}, shapes: s});
          let count = 1;
          edits.forEach(([what, a, b, x]) => {
            const shapes = h.current(history).shapes;
            const all = m.paths(shapes);
            const path = all[a % Math.max(1, all.length)];
            const places = [[x, b], [x + 3, b], [x + 3, b + 2.00049]];
            const areas = all.filter((p) => p.kind === "survey");
            let next = shapes;
            if (what === "add") next = m.addRing(shapes, "no_go", places).shapes;
            if (what === "hole" && areas.length) {
              next = m.addRing(shapes, "survey", places, areas[0]).shapes;
            }
            const i = path ? b % m.pointsOf(shapes, path).length : 0;
            if (path && what === "move") next = m.moveVertex(shapes, path, i, [x, x / 3]);
            if (path && what === "insert") next = m.insertVertex(shapes, path, i);
            if (path && what === "remove") next = m.removeVertex(shapes, path, i);
            if (path && what === "drop") next = m.removeRing(shapes, path);
            if (path && what === "shift") next = m.moveRing(shapes, path, x, -x);
            history = h.record(history, {changes: {}, shapes: next});
          });
          const end = h.current(history);
          const states = history.states.flatMap(({shapes}) => m.paths(shapes).map(
            (path) => [path.kind, m.pointsOf(shapes, path)]));
          while (h.canUndo(history)) history = h.undo(history);
          const first = h.current(history);
          while (h.canRedo(history)) history = h.redo(history);
          return [first, end, h.current(history), states];
        })()""",
        s=SHAPES, edits=edits,
    )  # fmt: skip
    assert start == {"changes": {}, "shapes": SHAPES}
    assert again == end
    for kind, points in states:
        assert len(points) >= (2 if kind == "corridors" else 3)
        assert np.allclose(1000 * np.array(points), np.round(1000 * np.array(points)), atol=1e-6)


def test_a_value_that_the_file_has_is_no_change(tmp_path: Path) -> None:
    file = {
        "settings": {"plan": {"altitude_m": 2.0, "line_spacing_m": 1.0, "side_overlap": 0.28}},
        "written": {"plan": ["line_spacing_m"]},
    }
    changed = run(
        tmp_path, "plan_changes",
        """[
          m.withChange({}, f, "plan", "altitude_m", 2.5),
          m.withChange({plan: {altitude_m: 2.5}}, f, "plan", "altitude_m", 2.0),
          m.withChange({}, f, "plan", "line_spacing_m", null),
          m.withChange({}, f, "plan", "altitude_m", null),
          m.withChanges({sea: {current_mps: 0.1}}, f,
            {plan: {side_overlap: 0.5, line_spacing_m: null}}),
          m.valueOf({plan: {line_spacing_m: null}}, f, "plan", "line_spacing_m"),
          m.valueOf({}, f, "plan", "altitude_m"),
          m.valueOf({}, f, "sea", "current_mps"),
        ]""",
        f=file,
    )  # fmt: skip
    assert changed == [
        {"plan": {"altitude_m": 2.5}}, {}, {"plan": {"line_spacing_m": None}}, {},
        {"sea": {"current_mps": 0.1}, "plan": {"side_overlap": 0.5, "line_spacing_m": None}},
        None, 2.0, None,
    ]  # fmt: skip


def test_no_answer_is_shown_after_that_of_a_newer_request(tmp_path: Path) -> None:
    """The first answer takes longest; the third fails."""
    asked, seen = run(
        tmp_path, "plan_latest",
        """(async () => {
          const pause = (ms) => new Promise((done) => setTimeout(done, ms));
          const [asked, seen] = [[], []];
          const way = m.latest({
            delay: 20,
            ask: async (state) => {
              asked.push(state);
              await pause({slow: 150, quick: 10, bad: 5}[state]);
              if (state === "bad") throw new Error("bad");
              return state;
            },
            shown: (answer) => seen.push(answer),
            failed: (error) => seen.push(error.message),
          });
          way.request("never"); way.request("slow"); await pause(60);
          way.request("quick"); await pause(250);
          way.request("bad"); await pause(60);
          way.request("quick"); way.stop(); await pause(60);
          return [asked, seen];
        })()""",
    )  # fmt: skip
    assert asked == ["slow", "quick", "bad"]
    assert seen == ["quick", "bad"]


def test_unknown_values_interrupt_a_line_and_ticks_are_round_and_within_limits(
    tmp_path: Path,
) -> None:
    limits = [(-12.31, -11.87, 5), (0.0, 1234.0, 5), (0.0, 4.0, 4), (-5.0, 0.0, 5)]
    path, found = run(
        tmp_path, "words",
        "[m.pathData([0, 1, 2, 3, 4], [1, 2, null, 3, 4]), l.map((row) => m.ticks(...row))]",
        l=limits,
    )  # fmt: skip
    assert path == "M0.0 1.0L1.0 2.0M3.0 3.0L4.0 4.0"
    for (low, high, maximum), (values, digits) in zip(limits, found, strict=True):
        assert 2 <= len(values) <= maximum + 1
        assert low - 1e-9 <= min(values) and max(values) <= high + 1e-9
        assert np.allclose(values, np.round(values, digits), atol=1e-9)
