"""Rows on light and strobes for the table of imaging settings."""

from alice_survey.base.config import CameraConfig, ImagingConfig
from missions.exposure import strobe as electric
from missions.exposure.light import MIDDLE_GREY, STROBE_KELVIN, LightBudget
from missions.exposure.scatter import Scatter, Shadows
from missions.exposure.strobe import StrobeLoad
from missions.exposure.table import Setting

_LIGHT = (
    "missions.exposure.light; water: Jerlov 1976 and Kirk 1984 (camera_calib.water); LEDs as a "
    f"Planck radiator of {STROBE_KELVIN:g} K; sand; lens transmission 0.9 (inferred)"
)
_SCATTER = "missions.exposure.scatter: single scattering, Henyey-Greenstein 0.924 (Petzold)"
_STROBE = (
    "Cree XHP35: 104 lm/W (koef3, 2024), 1.8 K/W and 85 C (data sheet); driver 0.9, bus 28 V, "
    "housing 0.5 K/W are inferred (missions.exposure.strobe)"
)


def light_rows(
    budget: LightBudget,
    imaging: ImagingConfig,
    limits: CameraConfig,
    jerlov: str,
    exposure_s: float,
) -> list[Setting]:
    """Electrons, signal to noise, gain, and the aperture or exposure that would fill the well."""
    strobes = len(imaging.strobes_body_m)
    dark = budget.gain_db > 0
    return [
        Setting(
            group="light",
            name="electrons, centre",
            value=budget.centre_e,
            unit="e",
            equation="pi L T / (4 N^2 n^2) p^2 t QE / (h nu)",
            source=_LIGHT,
            bound_by="exposure",
            note=f"red / green / blue of a pixel over sand in Jerlov {jerlov} water, {strobes} "
            f"strobes of {imaging.strobe_lumens:g} lm, F/{limits.f_number:g}; the brightest pixel "
            f"fills {budget.full_share:.1%} of the well of {limits.full_well_e:g} e",
        ),
        Setting(
            group="light",
            name="electrons, corner",
            value=budget.corner_e,
            unit="e",
            equation="the same, with cos^4",
            source=_LIGHT,
            bound_by="lens, beam",
        ),
        Setting(
            group="light",
            name="signal to noise",
            value=budget.snr_centre,
            unit="",
            equation="S / sqrt(S + read^2)",
            source="Poisson shot noise and read noise",
            bound_by="electrons",
            note=f"at the centre; of the median pixel {budget.snr_median:.1f}, in the corner "
            + " / ".join(f"{value:.1f}" for value in budget.snr_corner),
        ),
        Setting(
            group="light",
            name="gain",
            value=budget.gain_db,
            unit="dB",
            equation="20 log10(grey x well / median)",
            source=_LIGHT,
            bound_by="light" if dark else "full well",
            note=f"brings the median to {MIDDLE_GREY:.0%} of full scale (linear); 0 dB puts the "
            "full well at full scale. Check it in the water: alice-survey plan gain PICTURES",
        ),
        Setting(
            group="light",
            name="f-number for half well",
            value=budget.half_full_f_number,
            unit="",
            equation="N sqrt(S / half well)",
            source=_LIGHT,
            bound_by="depth of field",
            note=f"for the brightest pixel in {exposure_s * 1e3:.3g} ms; or "
            f"{budget.half_full_exposure_s * 1e3:.3g} ms at F/{limits.f_number:g}"
            + ("; no common lens opens so far" if budget.half_full_f_number < 1.2 else ""),
        ),
    ]


def scatter_rows(water: Scatter, shade: Shadows) -> list[Setting]:
    """Veiling light and shadows."""
    return [
        Setting(
            group="light",
            name="veil, centre",
            value=water.veil_share,
            unit="%",
            equation="B / (B + L)",
            source=_SCATTER,
            bound_by="strobe places",
            note="share of the light that the water throws back before it reached the floor, red / "
            f"green / blue. Strobes light the axis from {water.lit_from_m:.2f} m below the glass "
            f"on, the field of view from {water.seen_lit_from_m:.2f} m; {water.lit_share:.0%} of "
            "the water on the axis is lit",
        ),
        Setting(
            group="light",
            name="shadows",
            value=shade.length_m,
            unit="m",
            equation="h r / (H - h)",
            source="geometry of the strobes' places",
            bound_by="strobe places",
            note=f"of a thing {shade.height_m:g} m high below the camera, by each strobe; their "
            f"light meets there at {shade.between_deg:.0f} deg"
            + (" from both sides: each lights the other's shadow" if shade.opposite else ""),
        ),
    ]


def strobe_rows(load: StrobeLoad) -> list[Setting]:
    """Pulse, duty cycle, energy, capacitor, heat."""
    return [
        Setting(
            group="strobes",
            name="pulse",
            value=load.pulse_s * 1e3,
            unit="ms",
            equation="t + 2 lead",
            source="strobe covers the exposure",
            bound_by="exposure",
            note=f"lit {load.lead_s * 1e3:g} ms before the exposure, out as long after it "
            "(strobe_lead_s)",
        ),
        Setting(
            group="strobes",
            name="duty cycle",
            value=load.duty,
            unit="%",
            equation="pulse / interval",
            source=_STROBE,
            bound_by="interval",
            note=f"LEDs bear {load.duty_limit:.0%} in water of {electric.WARM_SEA_C:g} C",
        ),
        Setting(
            group="strobes",
            name="energy a trigger",
            value=load.frame_j,
            unit="J",
            equation="lm / (lm/W) x pulse / driver",
            source=_STROBE,
            bound_by="pulse",
            note=f"{load.count} strobes of {load.lit_w:.0f} W while lit, {load.peak_a:.1f} A from "
            f"{electric.BUS_V:g} V",
        ),
        Setting(
            group="strobes",
            name="capacitor, each",
            value=load.capacitor_f * 1e3,
            unit="mF",
            equation="2 E / (V^2 - V_low^2)",
            source=_STROBE,
            bound_by="pulse",
            note=f"feeds a pulse while its {electric.BUS_V:g} V sag by {electric.BUS_SAG:.0%}; "
            "continuous drive needs none",
        ),
        Setting(
            group="strobes",
            name="mean power",
            value=load.mean_w,
            unit="W",
            equation="energy / interval",
            source=_STROBE,
            bound_by="duty cycle",
            note=f"from the battery, on lines; solder point {load.solder_c:.0f} C, junction "
            f"{load.junction_c:.0f} C at most. Cameras and recorder are in vehicle.hotel_w",
        ),
    ]
