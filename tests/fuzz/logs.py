"""Logs of vehicles: what `import-log`, `import-images`, `fly`, `plan check` and `identify` read."""

import json
import tomllib
from datetime import UTC
from functools import partial
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from alice_survey.sim.vehicle import log as vehicle_log
from alice_survey.sim.vehicle.identification.two_step import read_pulls
from alice_survey.sim.vehicle.sea import read_current
from alice_survey.sim.vehicle.vehicle import (
    coefficients_from_file,
    speeds_missing,
    vehicle_from_file,
)
from missions.coverage import dive_record
from missions.logs.dead_reckoning import TrackErrors
from missions.logs.import_log import (
    ImportOptions,
    dead_reckon,
    navigation_table,
    read_dive,
    read_tide,
)
from missions.logs.navigation_csv import read_navigation
from reconstruct.pictures.incoming import pair_by_time
from tests.fuzz.target import Target
from tests.missions.exports.plans import RIG, line, plan_of
from tests.missions.logs.log_files import Bag, dataflash_log, tlog
from tests.missions.logs.test_import_ulog import dive, ulog

_START_NS = 1_714_564_800_000_000_000


def read_any_log(path: Path) -> object:
    """As `import-log` until it writes; of a side file, the log in whose folder it is."""
    log = path.parent if path.parent.name == "bag" else path
    options = ImportOptions(lever_body_m=(0.1, 0.0, 0.2))
    found = read_dive(log, options)
    lever = options.lever_body_m if found.attitude is not None else (0.0, 0.0, 0.0)
    return navigation_table(found, found.row_times, ImportOptions(lever_body_m=lever), 0.0)


def _bag(path: Path, version: int = 2, storage: StoragePlugin = StoragePlugin.MCAP) -> None:
    bag = Bag(version)
    for i in range(12):
        bag.add_nav_sts(
            _START_NS + i * 10**8, (41.7 + 1e-6 * i, 3.03, 5.0), (0.01, -0.02, 3.1), 2.5
        )
        bag.add_range(_START_NS + i * 10**8, "/sonar/ping", 4.0)
    bag.write(path if version == 1 else path.parent, storage)


def _dvl() -> str:
    lines = []
    for i in range(12):
        micro = 1_714_564_800_000_000 + 100_000 * i
        lines += [
            '{"time": 100.0, "vx": 0.4, "vy": -0.01, "vz": 0.02, "fom": 0.001, "altitude": 2.5, '
            f'"velocity_valid": true, "status": 0, "time_of_validity": {micro}, '
            '"type": "velocity"}',
            f'{{"ts": {micro / 1e6}, "x": 1, "y": 2, "z": 3, "std": 0.01, "roll": 1.5, '
            f'"pitch": -2, "yaw": {i}, "type": "position_local", "status": 0}}',
        ]
    return _text(lines)


def read_dead_reckoned(path: Path) -> object:
    """As `import-log --dead-reckon`."""
    options = ImportOptions(dead_reckon=TrackErrors(), start_at=(43.0, 5.0, 2.0))
    return dead_reckon(path, read_dive(path, options), options)


def _dive() -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = [
        ("GPS", 5 * 10**7, 0, 3, 302_418_000, 2312, 12, 0.8, 60.1, 5.25, 3.0, 0.1, 0.0, 0.0, 0.0, 1)
    ]
    for i in range(12):
        t = 51_000_000 + i * 100_000
        rows += [
            ("ATT", t - 20_000, 0.0, 1.5, 0.0, -2.25, 0.0, 1.0 + i, 0.0, 0.0, 3),
            ("POS", t, 60.1 + 1e-6 * i, 5.25, 1.0, -(4.0 + 0.25 * i), -99.0),
            ("RFND", t + 10_000, 0, 2.5, 4, 25),
            ("XKF1", t, 0, 1.5, -2.25, 3.0, 0.5, 0.0, 0.1, 0.1, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0),
            ("BARO", t, 0, -3.0, 1e5),
        ]
    return rows


def read_pairing(path: Path) -> object:
    """As `import-images --triggers`."""
    sides = {side: [Path(f"{side}/{k}.jpg") for k in range(5)] for side in ("left", "right")}
    return pair_by_time(sides, path, UTC)


def _telemetry(path: Path) -> None:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    records = []
    for i in range(12):
        t, ms = 1.7e9 + 0.2 * i, 90_000 + 200 * i
        place = (round(60.1e7) + 10 * i, 52_500_000, 0, -(3000 + 50 * i), 30, -40, 5, 65535)
        records += [
            (t, mavlink.MAVLink_heartbeat_message(12, 3, 81, 0, 3, 3)),
            (t, mavlink.MAVLink_attitude_message(ms, 0.1, -0.05, 0.1, 0.01, 0.02, 0.03)),
            (t, mavlink.MAVLink_global_position_int_message(ms, *place)),
            (t, mavlink.MAVLink_distance_sensor_message(ms, 20, 3000, 180 + i, 0, 0, 25, 255)),
        ]
    path.write_bytes(tlog(records))


def navigation_rows(*, dated: bool) -> list[str]:
    names = "latitude_deg,longitude_deg,depth_m,roll_deg,pitch_deg,heading_deg,altitude_m"
    rows = [f"{'time_utc' if dated else 'time_s'},{names}"]
    for i in range(12):
        time = f"2024-05-01T12:00:{i:02d}Z" if dated else f"{i}.5"
        rows.append(f"{time},32.8{i:02d},34.95,13.{i},0.1,0.2,{355 + i},2.0")
    return rows


def _text(rows: list[str]) -> str:
    return "\n".join(rows) + "\n"


def read_nav(path: Path) -> object:
    """As `import-images --navigation`: read, and interpolated at other times."""
    return read_navigation(path, UTC).at(np.linspace(-5.0, 60.0, 40))


def read_triggers(path: Path) -> object:
    return dive_record.read_triggers(path, read_navigation(path.with_name("n.csv"), UTC))


def _triggers(path: Path) -> None:
    path.with_name("n.csv").write_text(_text(navigation_rows(dated=True)))
    rows = ["time_utc,line", *(f"2024-05-01T12:00:{i:02d}Z,0" for i in range(9))]
    path.write_text(_text(rows))


def check_dive(path: Path) -> object:
    """As `plan check LOG`: the stations of a dive, for a plan of two lines."""
    plan = plan_of([line((0.0, 0.0), (5.0, 0.0)), line((5.0, 1.0), (0.0, 1.0))], [(0, 1)])
    return dive_record.read_dive_record(path, plan, RIG)


def read_vehicle_log(path: Path) -> object:
    return vehicle_log.segments(vehicle_log.read_vehicle_log(path))


def _column_map(path: Path) -> None:
    path.with_name("map.toml").write_text(
        'time = "t"\ntime_unit_s = 0.001\nbody = "flu"\nworld = "enu"\n'
        'velocity = ["vx", "vy", "vz"]\nquaternion_xyzw = ["a", "b", "c", "d"]\n'
        '[rpm]\nstern = "m1"\n'
    )
    rows = ["t,vx,vy,vz,a,b,c,d,m1", *(f"{100 * i},0.2,0,0,0,0,0,1,300" for i in range(9))]
    path.with_name("log.csv").write_text(_text(rows))


def swelling_bag(folder: Path, packed: str, size: int) -> Path:
    """A navigation log with one message more, of a number of zeros, in packed chunks."""
    bag = Bag(1 if packed == "bz2" else 2)
    bag.add_nav_sts(_START_NS, (41.7, 3.03, 5.0), (0.01, -0.02, 3.1), 2.5)
    writer: Writer1 | Writer2
    if packed == "bz2":
        path = folder / "a.bag"
        writer = one = Writer1(path)
        one.set_compression(Writer1.CompressionFormat.BZ2)
    else:
        path = folder / "a"
        writer = two = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
        two.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        bag.fill(writer)
        connection = writer.add_connection("/x", "std_msgs/msg/String", typestore=bag.store)
        writer.write(connection, _START_NS, bytes(size))
    return path if path.is_file() else path / "a.mcap"


def read_foreign(path: Path) -> object:
    columns = vehicle_log.read_column_map(path.with_name("map.toml"))
    return vehicle_log.read_foreign_log(path.with_name("log.csv"), columns)


def read_vehicle(path: Path) -> object:
    return vehicle_from_file(path), speeds_missing(path)


_VEHICLE = (
    Path(__file__).parents[1] / "alice_survey/sim/vehicle/identification/bluerov2.toml"
).read_text()
_PAIRING = [f"{side},{k},{10.5 + k}" for k in range(5) for side in ("left", "right")]
_DIVE = [
    "time_s,latitude_deg,longitude_deg,depth_m,roll_deg,pitch_deg,heading_deg,altitude_m",
    *(f"{i},{32.8236 + 2e-6 * i:.7f},34.9553,13.0,0,0,{i % 3},2.0" for i in range(40)),
]
_TIDE = ["time_utc,height_m", *(f"2024-05-01T{h:02d}:00:00Z,0.{h}" for h in range(9))]
_VEHICLE_LOG = [
    "time_s,north_m,east_m,depth_m,quat_x,quat_y,quat_z,quat_w,u_mps,v_mps,w_mps,"
    "p_rad_s,q_rad_s,r_rad_s,rpm_stern",
    *(f"{0.1 * i:.1f},0.0,0.0,10.0,0,0,0,1,0.2,0,0,0,0,0.01,300" for i in range(20)),
]
_COEFFICIENTS = ["X_u = -4.0", "X_uu = -18.0", "Y_v = -6.0", "X_udot = -5.5", "N_r = -0.1"]
_PULLS = ["thruster,rpm,force_n", "stern,300,12.5", "stern,-300,-9", "stern,600,50"]
_CURRENT = [
    "time_s,depth_m,north_mps,east_mps",
    *(f"{t},{d},0.1,0.02" for t in (0, 60, 120) for d in (5, 10, 15)),
]
_OF_TEXT = (
    ("trigger log of pictures", "p.csv", ["camera,number,time_s", *_PAIRING], read_pairing),
    ("navigation CSV", "n.csv", navigation_rows(dated=False), read_nav),
    ("navigation CSV, dated", "n.csv", navigation_rows(dated=True), read_nav),
    ("log to check", "d.csv", _DIVE, check_dive),
    ("tide", "tide.csv", _TIDE, lambda path: read_tide(str(path), dated=True)),
    ("vehicle log", "v.csv", _VEHICLE_LOG, read_vehicle_log),
    ("bollard pull", "pull.csv", _PULLS, read_pulls),
    ("current", "current.csv", _CURRENT, read_current),
)
_DATAFLASH = partial(Path.write_bytes, data=dataflash_log(_dive()))
_ULOG = partial(Path.write_bytes, data=ulog(dive(6)))
_SQLITE = partial(_bag, storage=StoragePlugin.SQLITE3)
_VEHICLE_JSON = json.dumps(tomllib.loads(_VEHICLE))
TARGETS = (
    *(Target(name, "csv", file, _text(rows), read) for name, file, rows, read in _OF_TEXT),
    Target("ROS 1 bag", "binary", "a.bag", partial(_bag, version=1), read_any_log),
    Target("ROS 2 bag, MCAP", "binary", "bag/bag.mcap", _bag, read_any_log),
    Target("ROS 2 bag, SQLite", "binary", "bag/bag.db3", _SQLITE, read_any_log),
    Target("ROS 2 bag, metadata", "text", "bag/metadata.yaml", _bag, read_any_log),
    Target("reports of a DVL", "json", "a.json", _dvl(), read_dead_reckoned),
    Target("ULog", "binary", "a.ulg", _ULOG, read_any_log),
    Target("DataFlash .BIN", "binary", "a.bin", _DATAFLASH, read_any_log),
    Target("tlog", "binary", "a.tlog", _telemetry, read_any_log),
    Target("triggers", "csv", "t.csv", _triggers, read_triggers),
    Target("column map", "toml", "map.toml", _column_map, read_foreign),
    Target("foreign log", "csv", "log.csv", _column_map, read_foreign),
    Target("vehicle TOML", "toml", "v.toml", _VEHICLE, read_vehicle),
    Target("vehicle JSON", "json", "v.json", _VEHICLE_JSON, read_vehicle),
    Target("coefficients", "toml", "c.toml", _text(_COEFFICIENTS), coefficients_from_file),
)
