"""QGC WPL 110, the plain-text missions that ArduSub's ground stations load."""

from pathlib import Path

from alice_survey.core.artefacts import atomic_path
from missions.exports.format import Export, ExportFile, ExportFormat
from missions.exports.mavlink import FRAME_GLOBAL, NAV_WAYPOINT, Item, item_of, mission_of
from missions.exports.xml_text import degrees
from missions.values.mission import Mission

_HEADER = "QGC WPL 110"
_CELLS = 12


def write_wpl(path: Path, export: Export, dive: int) -> None:
    """Write mission items, tab separated, after a row for home.

    The format has no comments: `about.txt` says what places and altitudes are of.
    """
    lat, lon = export.home_lat_lon_deg
    home = Item(command=NAV_WAYPOINT, frame=FRAME_GLOBAL, params=(0, 0, 0, 0, lat, lon, 0.0))
    rows = [_HEADER]
    for index, item in enumerate((home, *export.items(dive))):
        *params, lat, lon, altitude = item.params
        cells = [str(index), str(int(index == 0)), str(item.frame), str(item.command)]
        cells += [f"{value:.6f}" for value in params]
        cells += [degrees(lat), degrees(lon), f"{altitude:.4f}", "1"]
        rows.append("\t".join(cells))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(rows) + "\n", encoding="ascii", newline="\n")


def read_wpl(text: str) -> Mission | None:
    """Read mission items; the first row is home, which is not flown to."""
    lines = text.lstrip("\ufeff").splitlines()
    if not lines or lines[0].strip() != _HEADER:
        return None
    items = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split()
        if not cells:
            continue
        if len(cells) != _CELLS:
            raise ValueError(f"line {number} has {len(cells)} cells, not {_CELLS}")
        items.append(item_of(cells[3], cells[2], cells[4:11], f"line {number}"))
    return mission_of(items[1:])


FORMAT = ExportFormat(
    read_by="QGroundControl, Mission Planner, MAVProxy: QGC WPL 110",
    files=(ExportFile("mission_dive{}.waypoints", "QGC WPL 110 mission for ArduSub", write_wpl),),
    read=read_wpl,
    is_flown=True,
)
