"""Which parts of a model are loaded, drawn and given up, run with node and the page's own three."""

import json
from pathlib import Path
from typing import Any

import pytest

import alice_survey.kit
from tests.alice_survey.app.studio.test_web_modules import WEB
from tests.alice_survey.kit.node import run_modules

THREE = Path(alice_survey.kit.__file__).parent / "web" / "vendor_mesh.js"
LIMIT_MIB = 7
VIEWS = """
import {readFileSync} from "node:fs";
import vm from "node:vm";
import {boxAbout, startDetail, tileOf} from "./model_detail.js";
vm.runInThisContext(readFileSync(THREE, "utf8"));

/* A square of 16 m east and north in three levels below the root, each part of 1 MiB. */
function square(name, e, n, half, depth) {
  const children = depth === 3 ? [] : [[-1, -1], [1, -1], [-1, 1], [1, 1]].map(([x, y], i) =>
    square(name + i, e + x * half / 2, n + y * half / 2, half / 2, depth + 1));
  const box = boxAbout([e, n, 0], [half, half, 0.1]);
  return tileOf({name, depth, children, error: half / 8, box, bytes: KNOWN ? 2 ** 20 : 0});
}

const loads = [];
const drops = [];
const failures = [];
let heard = null;
let asked = true;
let most = 0;
const camera = new three.PerspectiveCamera(40, 1, 0.01, 1000);
const canvas = {height: 400, dataset: LIMIT ? {maxMib: String(LIMIT)} : {}};
const detail = startDetail({camera, canvas, draw() { asked = true; }}, square("r", 0, 0, 16, 0), {
  errorPx: 8,
  async load({name}) {
    loads.push(name);
    if (BAD.includes(name)) throw new Error(name);
    const model = new three.Scene();
    model.name = name;
    return {model, bytes: 2 ** 20};
  },
  drop: (model) => drops.push(model.name),
  progress: (now) => { heard = now; most = Math.max(most, now.bytes / 2 ** 20); },
  failed: (fault) => failures.push(fault.message),
});

async function seen([e, n, up]) {
  camera.position.set(e, up, -n);
  camera.lookAt(e, 0, -n);
  detail.moved();
  asked = true;
  let frames = 0;
  while (asked && frames < 500) {
    asked = false;
    detail.update();
    frames += 1;
    await new Promise((done) => setTimeout(done, 0));
  }
  const drawn = heard.parts.map(({name}) => name).sort();
  return {drawn, coming: heard.coming, mib: heard.bytes / 2 ** 20, frames, most};
}
const views = [];
for (const place of PLACES) views.push(await seen(place));
console.log(JSON.stringify({views, loads, drops, failures}));
"""


def look(
    folder: Path,
    *places: tuple[float, float, float],
    limit: float | None = None,
    bad: tuple[str, ...] = (),
    known: bool = False,
) -> Any:
    """Look straight down from places (east, north, up), one after the other."""
    values = {
        "THREE": str(THREE), "PLACES": places, "LIMIT": limit, "BAD": bad,
        "KNOWN": known,
    }  # fmt: skip
    named = "\n".join(f"const {name} = {json.dumps(value)};" for name, value in values.items())
    found = run_modules(WEB, folder, named + VIEWS)
    for view in found["views"]:
        assert view["coming"] == 0
        assert view["frames"] < 200
    return found


FAR, WEST, EAST = (0.0, 0.0, 400.0), (-12.0, -12.0, 6.0), (12.0, 12.0, 6.0)


def test_only_what_the_view_needs_is_loaded(tmp_path: Path) -> None:
    found = look(tmp_path, FAR, WEST)
    far, west = found["views"]
    assert far["drawn"] == ["r"]
    assert west["drawn"] == ["r000", "r001", "r002", "r003"]
    assert found["loads"][0] == "r"
    assert len(found["loads"]) == len(set(found["loads"])) < 20  # of 85
    assert not any(name.startswith("r3") for name in west["drawn"])


@pytest.mark.parametrize("known", [False, True])
def test_memory_is_bounded_and_views_still_settle(known: bool, tmp_path: Path) -> None:
    """From corner to corner with room for one corner's parts, then a view that has no room."""
    found = look(tmp_path, WEST, EAST, WEST, (0, 0, 30), FAR, limit=LIMIT_MIB, known=known)
    west, east, again, middle, far = found["views"]
    assert west["drawn"] == again["drawn"]
    corner = {name for name in east["drawn"] if len(name) == 4}
    assert corner == {"r330", "r331", "r332", "r333"}
    assert set(found["drops"]) >= {"r000", "r001", "r002", "r003"}
    assert 1 <= len(middle["drawn"]) <= LIMIT_MIB  # coarser than it would be: 21 parts and more
    unlimited = look(tmp_path, (0, 0, 30))["views"][0]
    assert len(unlimited["drawn"]) > LIMIT_MIB
    assert far["drawn"] == ["r"]
    for view in found["views"]:
        assert view["mib"] <= LIMIT_MIB
        assert view["most"] <= LIMIT_MIB + (0 if known else 4)  # those that came at once


def test_a_limit_below_one_part_still_draws_it(tmp_path: Path) -> None:
    (view,) = look(tmp_path, (0, 0, 30), limit=0.1)["views"]
    assert view["drawn"] == ["r"]


def test_what_does_not_come_is_stood_for_by_its_parent(tmp_path: Path) -> None:
    """And is asked for once; where that did not come either, the rest is drawn."""
    found = look(tmp_path, WEST, FAR, WEST, bad=("r001",))
    assert found["failures"] == ["r001"]
    assert found["views"][2]["drawn"] == ["r00"]
    found = look(tmp_path, WEST, bad=("r00", "r0", "r"))
    assert found["views"][0]["drawn"] == ["r000", "r001", "r002", "r003"]
    found = look(tmp_path, WEST, bad=("r00", "r0", "r", "r002"))
    assert found["views"][0]["drawn"] == ["r000", "r001", "r003"]
