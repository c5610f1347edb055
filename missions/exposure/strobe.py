"""Strobes as electric loads: pulse, duty cycle, energy, capacitor, heat.

Two arrays of 20 Cree XHP35 LEDs (Gutnik et al. 2021, section III.B), 1500 lm each. Of the LED:
1354 lm at 1 A and 13.01 V, so 104 lm/W (measured on an XHP35.2 HI, 5000 K, by "koef3",
budgetlightforum.com, 2024; that ALICE's give the same is inferred), junction to solder point
1.8 K/W, junction 150 C at most, flux stated at 85 C (Cree's data sheet).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from alice_survey.core.config import ImagingConfig, PlanConfig
from alice_survey.core.errors import PlanError
from missions.exposure.settings_table import Setting, settings_of
from missions.exposure.ways_out import Way, conflict, less_overlap

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
_SOURCE = (
    "Cree XHP35: 104 lm/W (koef3, 2024), 1.8 K/W and 85 C (data sheet); driver 0.9, bus 28 V, "
    "housing 0.5 K/W are inferred (missions.exposure.strobe)"
)


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
    limit = duty_limit(imaging)
    duty = pulse_s / interval_s
    if duty > limit:
        raise _too_long(imaging, plan, exposure_s, interval_s, limit)
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


def _too_long(
    imaging: ImagingConfig, plan: PlanConfig, exposure_s: float, interval_s: float, limit: float
) -> PlanError:
    """The pulse is too long for the interval."""
    pulse_s, max_s = exposure_s + 2 * plan.strobe_lead_s, limit * interval_s
    slower = pulse_s / max_s

    def ways() -> Iterator[Way]:
        if max_s > exposure_s:
            lead_s = math.floor((max_s - exposure_s) / 2 * 1e5) / 1e5
            yield Way(
                change=f"strobe_lead_s {lead_s:g} instead of {plan.strobe_lead_s:g}",
                price="the strobe has less time to reach its brightness",
                cost=1.0 - lead_s / plan.strobe_lead_s,
                settings={"plan.strobe_lead_s": lead_s},
            )
        if max_s > 2 * plan.strobe_lead_s:
            share = (max_s - 2 * plan.strobe_lead_s) / exposure_s
            blur_px = math.floor(100 * plan.allowed_blur_px * share) / 100
            yield Way(
                change=f"allowed_blur_px {blur_px:g} instead of {plan.allowed_blur_px:g}",
                price=f"{share:.2f} of the light: {-20 * math.log10(share):.1f} dB more gain",
                cost=1.0 - share,
                settings={"plan.allowed_blur_px": blur_px},
            )
        yield from less_overlap(plan, 1.0 - (1.0 - plan.forward_overlap) * slower)
        lumens = math.floor(imaging.strobe_lumens / slower / 100) * 100
        yield Way(
            change=f"strobe_lumens {lumens:g} instead of {imaging.strobe_lumens:g}",
            price=f"{20 * math.log10(slower):.1f} dB more gain",
            cost=1.0 - 1.0 / slower,
            settings={"imaging.strobe_lumens": lumens},
        )

    return conflict(
        f"a strobe pulse of {pulse_s:.4f} s (exposure {exposure_s:.4f} s, lead "
        f"{plan.strobe_lead_s:g} s) every {interval_s:.3f} s lights {pulse_s / interval_s:.0%} of "
        f"the time; its LEDs bear {limit:.0%} in water of {WARM_SEA_C:g} C",
        ("strobe pulse", "heat of the strobe"),
        ways(),
    )


def strobe_rows(load: StrobeLoad) -> list[Setting]:
    """Pulse, duty cycle, energy, capacitor, heat."""
    return settings_of("strobes", [
        ("pulse", load.pulse_s * 1e3, "ms", "t + 2 lead", "strobe covers the exposure", "exposure",
         f"lit {load.lead_s * 1e3:g} ms before the exposure, out as long after it "
         "(strobe_lead_s)"),
        ("duty cycle", load.duty, "%", "pulse / interval", _SOURCE, "interval",
         f"LEDs bear {load.duty_limit:.0%} in water of {WARM_SEA_C:g} C"),
        ("energy a trigger", load.frame_j, "J", "lm / (lm/W) x pulse / driver", _SOURCE, "pulse",
         f"{load.count} strobes of {load.lit_w:.0f} W while lit, {load.peak_a:.1f} A from "
         f"{BUS_V:g} V"),
        ("capacitor, each", load.capacitor_f * 1e3, "mF", "2 E / (V^2 - V_low^2)", _SOURCE, "pulse",
         f"feeds a pulse while its {BUS_V:g} V sag by {BUS_SAG:.0%}; "
         "continuous drive needs none"),
        ("mean power", load.mean_w, "W", "energy / interval", _SOURCE, "duty cycle",
         f"from the battery, on lines; solder point {load.solder_c:.0f} C, junction "
         f"{load.junction_c:.0f} C at most. Cameras and recorder are in vehicle.hotel_w"),
    ])  # fmt: skip
