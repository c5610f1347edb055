"""Strobes as electric loads (pulse, duty cycle, energy, capacitor, heat), and the data of pictures.

Two arrays of 20 Cree XHP35 LEDs (Gutnik et al. 2021, section III.B), 1500 lm each. Of the LED:
1354 lm at 1 A and 13.01 V, so 104 lm/W (measured on an XHP35.2 HI, 5000 K, by "koef3",
budgetlightforum.com, 2024; that ALICE's give the same is inferred), junction to solder point
1.8 K/W, junction 150 C at most, flux stated at 85 C (Cree's data sheet).
"""

import math
from dataclasses import dataclass

from alice_survey.core.config import ImagingConfig, PlanConfig
from camera_calib.camera import Camera
from missions.exposure.conflict import conflict

LEDS = 20
EFFICACY_LM_W = 1354.0 / 13.01
DRIVER_EFFICIENCY = 0.9
"""Inferred: a switched LED driver."""
LED_KELVIN_PER_WATT = 1.8
BUS_V, BUS_SAG = 28.0, 0.10
"""Inferred: a lithium-ion battery of 7 to 8 cells; the sag that its other loads tolerate."""
HOUSING_KELVIN_PER_WATT = 0.5
"""Inferred: 0.02 m^2 of metal in water at 100 W/(m^2 K), the low end of free convection in liquids
(Incropera, Fundamentals of Heat and Mass Transfer, table 1.1)."""
WARM_SEA_C, SOLDER_LIMIT_C = 30.0, 85.0
LINK_BYTES_PER_S = 124e6
"""Capacity of one Gigabit Ethernet cable: the cameras' `StreamBytesPerSecond` at full bandwidth
(Allied Vision, Manta Technical Manual, notes on frame rates)."""
DISK_BYTES_PER_S = 250e6
"""Inferred: half of what a SATA disk on the recorder writes at best (about 500 MB/s)."""


@dataclass(frozen=True, kw_only=True)
class StrobeLoad:
    """What the strobes need from the vehicle; powers and energies are electric."""

    count: int
    pulse_s: float
    lead_s: float
    duty: float
    """Share of the time for which they are lit."""
    duty_limit: float
    """Duty cycle at which an LED's solder point reaches its limit in warm water."""
    lit_w: float
    """Power of one strobe while it is lit, at the LEDs."""
    frame_j: float
    """Energy from the battery, for all strobes and one picture."""
    mean_w: float
    """Mean power from the battery, for all strobes."""
    peak_a: float
    """Current from the battery while all are lit, without a capacitor."""
    capacitor_f: float
    """Capacity that feeds one pulse of one strobe within `BUS_SAG` of `BUS_V`."""
    solder_c: float
    """Mean temperature of the LEDs' solder points in water of `WARM_SEA_C`."""
    junction_c: float
    """Highest junction temperature: mean of the solder point and the rise of a long pulse."""


def strobe_load(
    imaging: ImagingConfig, plan: PlanConfig, exposure_s: float, interval_s: float
) -> StrobeLoad:
    """Pulse and what it takes.

    Raises:
        PlanError: the strobes would be lit for a larger share of the time than they can take.
    """
    pulse_s = exposure_s + 2 * plan.strobe_lead_s
    lit_w = imaging.strobe_lumens / EFFICACY_LM_W
    limit, duty = duty_limit(imaging), pulse_s / interval_s
    if duty > limit:
        share = (limit * interval_s - 2 * plan.strobe_lead_s) / exposure_s
        raise conflict(
            f"a strobe pulse of {pulse_s:.4f} s every {interval_s:.3f} s lights {duty:.0%} of the "
            f"time; its LEDs bear {limit:.0%} in water of {WARM_SEA_C:g} C",
            ("strobe pulse", "heat of the strobe"),
            "plan.allowed_blur_px", math.floor(100 * plan.allowed_blur_px * share) / 100,
        )  # fmt: skip
    count = len(imaging.strobes_body_m)
    frame_j = count * lit_w * pulse_s / DRIVER_EFFICIENCY
    solder_c = WARM_SEA_C + HOUSING_KELVIN_PER_WATT * lit_w * duty
    return StrobeLoad(
        count=count,
        pulse_s=pulse_s,
        lead_s=plan.strobe_lead_s,
        duty=duty,
        duty_limit=limit,
        lit_w=lit_w,
        frame_j=frame_j,
        mean_w=frame_j / interval_s,
        peak_a=count * lit_w / DRIVER_EFFICIENCY / BUS_V,
        capacitor_f=capacitor_f(lit_w * pulse_s / DRIVER_EFFICIENCY),
        solder_c=solder_c,
        junction_c=solder_c + LED_KELVIN_PER_WATT * lit_w / LEDS,
    )


def capacitor_f(energy_j: float, volt: float = BUS_V, sag: float = BUS_SAG) -> float:
    """Capacity that gives an energy while its voltage falls by a share: 2 E / (V^2 - V_low^2)."""
    return 2.0 * energy_j / (volt**2 * (1.0 - (1.0 - sag) ** 2))


def duty_limit(imaging: ImagingConfig) -> float:
    """Share of the time for which a strobe may be lit; all of its power counts as heat."""
    lit_w = imaging.strobe_lumens / EFFICACY_LM_W
    return min(1.0, (SOLDER_LIMIT_C - WARM_SEA_C) / (HOUSING_KELVIN_PER_WATT * lit_w))


@dataclass(frozen=True, kw_only=True)
class Storage:
    """Data of one trigger and what limits their flow."""

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
        station_bytes=station,
        bytes_per_s=station / interval_s,
        own_link_hz=LINK_BYTES_PER_S / frame,
        shared_link_hz=LINK_BYTES_PER_S / station,
        disk_hz=DISK_BYTES_PER_S / station,
    )
