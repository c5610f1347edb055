"""Pictures and logs such as readers bring along, made from the pictures and logs of a survey."""

import csv
import math
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from alice_survey.core.artefacts import write_csv
from alice_survey.core.config import CameraConfig, WaterConfig
from alice_survey.core.frames import Array, Datum, rotation_from_attitude
from alice_survey.sim.vehicle.log import write_vehicle_log
from alice_survey.sim.vehicle.vehicle import vehicle_from_file
from camera_calib.camera import Camera
from camera_calib.formats.convert import FORMATS
from camera_calib.rig import Rig, design_rig
from camera_calib.targets.target import parse_target
from missions.logs.ros_builder import flipped_quaternion
from tests.alice_survey.sim.vehicle.identification.manoeuvres import fly, measured
from tests.camera_calib.calibration_scenes import board_poses, in_air
from tests.cameras import changed
from tests.docs.pages import DOCS, written
from tests.missions.logs.log_files import Bag, dataflash_log, tlog
from tests.missions.logs.test_import_ulog import dive as px4_dive
from tests.missions.logs.test_import_ulog import ulog
from tests.oracles_targets import light_through, to_srgb
from tests.reconstruct.pictures.dated import save

SAID = datetime(2024, 5, 1, 9, 0, 0, tzinfo=UTC)
"""When the simulated flight is said to have begun."""
WEEK, WEEK_BEGAN = 2312, datetime(2024, 4, 28, tzinfo=UTC)
LEAP_S = 18
"""GPS time is ahead of UTC by this since 2017."""
BOARD = "charuco 12x9 40mm 30mm"
VIEWS = 8
FAST_S = 1.5
"""By which the clocks of cameras are ahead."""


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def flown_rows(reef: Path, every: int) -> NDArray[Any]:
    """Rows of the navigation of the flight, with named columns."""
    return np.genfromtxt(reef / "flight/navigation.csv", delimiter=",", names=True)[::every]


def boards(folder: Path, *, air: bool) -> None:
    """Write `air/` or `pool/`: a board before the designed cameras, at a quarter of their size."""
    rig = design_rig(CameraConfig(), WaterConfig(n_water=1.3335), 4)  # fresh, as of a pool
    target = parse_target(BOARD)
    looking = in_air(rig) if air else rig
    near_m, far_m = (0.6, 1.0) if air else (0.75, 1.1)
    rng = np.random.default_rng(7 if air else 8)
    poses = board_poses(looking, VIEWS, rng, near_m=near_m, far_m=far_m, points=target.points)
    for name, camera in looking.cameras.items():
        place = folder / ("air" if air else "pool") / name
        place.mkdir(parents=True)
        for view in range(VIEWS):
            board_from_cam = (looking.cam_from_rig[name] * poses[view]).inv()
            light = light_through(target, camera, board_from_cam, fine=2)
            cv2.imwrite(str(place / f"{view:02d}.png"), to_srgb(light))


def shrunk(picture: NDArray[np.uint8], width_px: int) -> NDArray[np.uint8]:
    """A picture at another width."""
    height = round(picture.shape[0] * width_px / picture.shape[1])
    small = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def smaller(reef: Path, folders: dict[str, Path], stations: Iterable[int], width_px: int) -> None:
    """Write `001.png` ... of some stations of a survey at another size, by camera."""
    for camera, folder in folders.items():
        folder.mkdir(parents=True)
        for number, station in enumerate(stations, start=1):
            picture = cv2.imread(str(reef / f"images/{camera}/{station:06d}.png"))
            cv2.imwrite(str(folder / f"{number:03d}.png"), shrunk(picture, width_px))


def calibrated_in_air(path: Path, kind: str) -> None:
    """Write the designed cameras as another tool would that calibrated them in air."""
    FORMATS[kind].write(path, in_air(design_rig(CameraConfig(), WaterConfig(), 4)))


def smaller_rig(rig: Rig, width_px: int) -> Rig:
    """The rig of pictures that were shrunk to a width."""

    def smaller_camera(camera: Camera) -> Camera:
        height = round(camera.height_px * width_px / camera.width_px)
        x, y = width_px / camera.width_px, height / camera.height_px
        return changed(
            camera, width_px=width_px, height_px=height, fx_px=camera.fx_px * x,
            fy_px=camera.fy_px * y, cx_px=camera.cx_px * x, cy_px=camera.cy_px * y,
        )  # fmt: skip

    cameras = {name: smaller_camera(camera) for name, camera in rig.cameras.items()}
    return replace(rig, cameras=cameras, covariance=None)


def photos(
    reef: Path,
    folder: Path,
    stations: Iterable[int],
    *,
    camera: str = "left",
    width_px: int | None = None,
    late_s: float = 0.0,
    gps: bool = False,
) -> None:
    """Write JPEGs with the time, or with time and place, in EXIF.

    Args:
        reef: a survey with its pictures.
        folder: to write.
        stations: whose pictures.
        camera: that took them.
        width_px: another size.
        late_s: by which its clock is ahead.
        gps: whether it knew its place.
    """
    rows = {
        int(row["station"]): row
        for row in rows_of(reef / "images/manifest.csv")
        if row["camera"] == camera
    }
    for number, station in enumerate(stations, start=1):
        row = rows[station]
        taken = SAID + timedelta(seconds=float(row["time_s"]) + late_s)
        picture = cv2.imread(str(reef / f"images/{camera}/{station:06d}.png"))
        if width_px is not None:
            picture = shrunk(picture, width_px)
        save(
            folder / f"DSC{number:04d}.jpg",
            np.ascontiguousarray(picture[..., ::-1]),
            taken=f"{taken:%Y:%m:%d %H:%M:%S}",
            fraction=f"{taken.microsecond // 1000:03d}",
            gps=(float(row["latitude_deg"]), float(row["longitude_deg"]), 0.0) if gps else None,
        )


def masks(pictures: Path, folder: Path) -> None:
    """Write masks that leave out the lowest tenth of each picture, where a frame might hang."""
    folder.mkdir(parents=True)
    for path in sorted(pictures.iterdir()):
        with Image.open(path) as picture:
            mask = np.full((picture.height, picture.width), 255, np.uint8)
        mask[-len(mask) // 10 :] = 0
        Image.fromarray(mask).save(folder / f"{path.stem}.png")


def navigation(reef: Path, path: Path, *, dated: bool) -> None:
    """Write the navigation of the flight at 4 Hz, with dates instead of seconds if requested."""
    header, *rows = (reef / "flight/navigation.csv").read_text().splitlines()
    lines = [header.replace("time_s", "time_utc") if dated else header]
    for row in rows[::5]:
        seconds, others = row.split(",", 1)
        when = (SAID + timedelta(seconds=float(seconds))).isoformat() if dated else seconds
        lines.append(f"{when},{others}")
    path.write_text("\n".join(lines) + "\n")


def vehicle_logs(reef: Path, folder: Path) -> None:
    """Write the flight as COLA2, ArduSub and a ground station would have logged it."""
    rows = flown_rows(reef, 10)
    bag, dvl = Bag(1), Bag(1)
    boot_us = 20_000_000
    messages: list[tuple[object, ...]] = []
    records: list[tuple[float, object]] = []
    for row in rows:
        now = SAID + timedelta(seconds=row["time_s"])
        place = (row["latitude_deg"], row["longitude_deg"], row["depth_m"])
        angles = (row["roll_deg"], row["pitch_deg"], row["heading_deg"])
        turned = tuple(math.radians(angle) for angle in angles)
        # A range is along the body's axis.
        slant_m = row["altitude_m"] / (math.cos(turned[0]) * math.cos(turned[1]))
        heard = math.isfinite(slant_m)
        stamp = round(now.timestamp() * 1e9)
        bag.add_nav_sts(stamp, place, turned, row["altitude_m"] if heard else -1.0)
        dvl.add_dvl(stamp, "/dvl/data", (0.2, 0.0, 0.0), slant_m, valid=heard)
        attitude = flipped_quaternion(rotation_from_attitude(*turned).as_quat())
        dvl.add_imu(stamp, "/imu", "imu", attitude)
        t = boot_us + round(row["time_s"] * 1e6)
        if not messages:
            since_ms = round(((now - WEEK_BEGAN).total_seconds() + LEAP_S) * 1e3)
            fix = (since_ms, WEEK, 12, 0.8, *place[:2], 0.0, 0.0, 0.0, 0.0, 0.0, 1)
            messages.append(("GPS", t, 0, 3, *fix))
        messages += [
            ("ATT", t, 0.0, angles[0], 0.0, angles[1], 0.0, angles[2] % 360, 0.0, 0.0, 3),
            ("POS", t, *place[:2], 0.0, -place[2], 0.0),
            *([("RFND", t, 0, slant_m, 4, 25)] if heard else []),
        ]
        ms, at = t // 1000, now.timestamp()
        whole = (round(place[0] * 1e7), round(place[1] * 1e7), 0, round(-1000 * place[2]))
        said = (0.2, 0.2, 0, 0, -place[2], 0.0)
        records += [
            (at, mavlink.MAVLink_heartbeat_message(12, 3, 81, 0, 3, 3)),
            (at, mavlink.MAVLink_attitude_message(ms, *turned, 0.0, 0.0, 0.0)),
            (at, mavlink.MAVLink_global_position_int_message(ms, *whole, 0, 0, 0, 65535)),
            (at, mavlink.MAVLink_vfr_hud_message(*said)),
        ]
    bag.write(folder / "sparus2.bag")
    dvl.write(folder / "dvl.bag")
    (folder / "flight.ulg").write_bytes(ulog(px4_dive()))
    reports = [
        '{"time": 100.0, "vx": 0.2, "vy": 0.0, "vz": 0.0, "altitude": 2.5, '
        f'"velocity_valid": true, "time_of_validity": {1_714_564_800_000_000 + 100_000 * i}, '
        '"type": "velocity"}\n'
        f'{{"ts": {1_714_564_800 + 0.1 * i}, "roll": 0.0, "pitch": 0.0, "yaw": 0.0, '
        f'"type": "position_local"}}\n'
        for i in range(100)
    ]
    (folder / "dvl.json").write_text("".join(reports))
    (folder / "00000042.BIN").write_bytes(dataflash_log(messages))
    (folder / "dive.tlog").write_bytes(tlog(records))
    tides = ((-1, 0.30), (0, 0.22), (1, 0.14))
    heights = [((SAID + timedelta(hours=hours)).isoformat(), m) for hours, m in tides]
    write_csv(folder / "tides.csv", ["time_utc", "height_m"], heights)


def robot_bag(reef: Path, path: Path, stations: Iterable[int], width_px: int) -> None:
    """Write small pictures of some stations, and what a DVL, an IMU and a depth sensor said."""
    rows = flown_rows(reef, 5)
    place = np.column_stack([rows[n] for n in ("latitude_deg", "longitude_deg", "depth_m")])
    speed = np.gradient(Datum(*place[0, :2]).ned_from_geodetic(place), rows["time_s"], axis=0)
    bag = Bag(1)
    for row, velocity in zip(rows, speed, strict=True):
        stamp = round((SAID + timedelta(seconds=row["time_s"])).timestamp() * 1e9)
        angles = (math.radians(row[n]) for n in ("roll_deg", "pitch_deg", "heading_deg"))
        turn = rotation_from_attitude(*angles)
        heard = math.isfinite(row["altitude_m"])
        bag.add_dvl(
            stamp, "/dvl/data", turn.inv().apply(velocity), row["altitude_m"] if heard else -1
        )
        bag.add_imu(stamp, "/imu", "imu", flipped_quaternion(turn.as_quat()))
        bag.add_pressure(stamp, "/pressure", 101325.0 + 1025.0 * 9.80665 * row["depth_m"])
    kind, wanted = "sensor_msgs/msg/CompressedImage", set(stations)
    for taken in rows_of(reef / "images/manifest.csv"):
        if int(taken["station"]) in wanted:
            seen = shrunk(cv2.imread(str(reef / "images" / taken["image"])), width_px)
            stamp = round((SAID + timedelta(seconds=float(taken["time_s"]))).timestamp() * 1e9)
            topic, data = f"/camera/{taken['camera']}/compressed", cv2.imencode(".png", seen)[1]
            bag.add(topic, kind, stamp, taken["camera"], format="png", data=data.ravel())
    bag.write(path)


OWN_VEHICLE = (
    written(DOCS / "how-to/own-vehicle.md", "own.toml")
    .replace("X_uu = -15.0", "X_uu = -21.0")
    .replace("N_rr = -10.0", "N_rr = -7.0")
)
"""A vehicle with three thrusters; what its owner knows of it stands in the page on it."""


def own_logs(folder: Path) -> None:
    """Write `dive1.csv` and `dive2.csv`: surge steps and zigzags of that vehicle."""
    path = folder / "truth.toml"
    path.write_text(OWN_VEHICLE)
    truth = vehicle_from_file(path)
    path.unlink()
    rng = np.random.default_rng(12)

    def asked(time_s: float) -> Array:
        surge = (22.0, 34.0, 14.0, -18.0)[int(time_s // 8.0) % 4]
        turn = (6.0, -9.0, 0.0)[int(time_s // 5.0) % 3]
        return np.array([surge + turn, surge - turn, 0.0])

    for name, seconds, heading_rad in (("dive1.csv", 48.0, 0.4), ("dive2.csv", 30.0, 2.0)):
        log = fly(truth, duration_s=seconds, asked=asked, attitude_rad=(0.0, 0.0, heading_rad))
        write_vehicle_log(folder / name, measured(log, rng))
