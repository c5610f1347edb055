"""Bytes that the cameras make, and whether cable and disk take them."""

from dataclasses import dataclass

from alice_survey.core.config import CameraConfig
from camera_calib.camera import Camera
from missions.exposure.settings_table import Setting, settings_of

LINK_BYTES_PER_S = 124e6
"""Capacity of one Gigabit Ethernet cable: the cameras' `StreamBytesPerSecond` at full bandwidth
(Allied Vision, Manta Technical Manual, notes on frame rates)."""
DISK_BYTES_PER_S = 250e6
"""Inferred: half of what a SATA disk on the recorder writes at best (about 500 MB/s)."""
_SOURCE = "Allied Vision, Manta Technical Manual (124 MB/s a link); disk 250 MB/s is inferred"


@dataclass(frozen=True, kw_only=True)
class Storage:
    """Data of one trigger and what limits their flow."""

    frame_bytes: int
    """Size of one picture, raw, one byte a pixel."""
    station_bytes: int
    """Size of all cameras' pictures of one trigger."""
    bytes_per_s: float
    """Data rate while a line is flown."""
    own_link_hz: float
    """Most triggers a second, each camera on its own cable."""
    shared_link_hz: float
    """Most triggers a second with all cameras on one cable."""
    disk_hz: float
    """Most triggers a second that the disk takes."""


def raw_bytes(camera: Camera, cameras: int, stations: int) -> int:
    """Size of all pictures as the sensor gives them, one byte a pixel."""
    return camera.width_px * camera.height_px * cameras * stations


def storage_load(camera: Camera, cameras: int, interval_s: float) -> Storage:
    """Data of a rig.

    Args:
        camera: the reference camera; all are taken for as large.
        cameras: how many.
        interval_s: between triggers.
    """
    frame, station = raw_bytes(camera, 1, 1), raw_bytes(camera, cameras, 1)
    return Storage(
        frame_bytes=frame,
        station_bytes=station,
        bytes_per_s=station / interval_s,
        own_link_hz=LINK_BYTES_PER_S / frame,
        shared_link_hz=LINK_BYTES_PER_S / station,
        disk_hz=DISK_BYTES_PER_S / station,
    )


def storage_rows(storage: Storage, limits: CameraConfig, interval_s: float) -> list[Setting]:
    """Picture, flow and limits."""
    rate_hz = 1.0 / interval_s
    ceilings = {
        "camera.shortest_interval_s": 1.0 / limits.shortest_interval_s,
        "a cable each": storage.own_link_hz,
        "disk": storage.disk_hz,
    }
    tightest = min(ceilings, key=lambda name: ceilings[name])
    shared = "" if rate_hz <= storage.shared_link_hz else "; ONE CABLE FOR ALL IS TOO SLOW HERE"
    return settings_of("data", [
        ("one trigger", storage.station_bytes / 1e6, "MB", "width x height x cameras",
         "raw, one byte a pixel", "sensor", ""),
        ("write rate on a line", storage.bytes_per_s / 1e6, "MB/s", "bytes / interval", _SOURCE,
         "interval",
         f"{rate_hz:.3g} triggers a second of at most {ceilings[tightest]:.3g} ({tightest})"
         f"; all cameras on one cable take {storage.shared_link_hz:.3g}{shared}"),
    ])  # fmt: skip
