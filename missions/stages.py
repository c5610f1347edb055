"""The stages that plan, fly and render a survey: what each depends on, makes and says.

Nothing here imports the modules that do the work: they are named, and loaded when a stage is made.
"""

from pathlib import Path

from alice_survey.core.artefacts import read_json
from alice_survey.core.manifest import read_manifest
from alice_survey.core.records import BoardRecord, FlightRecord
from alice_survey.core.stages import WHOLE, StageSpec, Summary, only, without
from alice_survey.kit.words import count, share


def _plan_summary(folder: Path) -> Summary:
    from alice_survey.core.frames import Datum

    plan = read_json(folder / "plan.json")
    lines, dives = count(len(plan["lines"]), "line"), count(len(plan["dives"]), "dive")
    text = (
        f"at {Datum(**plan['datum']).place}: {lines}, {count(plan['stations'], 'station')}, "
        f"{plan['length_m']:.0f} m, {plan['duration_s'] / 60:.0f} min, {plan['energy_wh']:.0f} Wh "
        f"in {dives}; overlap {plan['forward_overlap']:.0%} forward, "
        f"{plan['side_overlap']:.0%} side, {share(plan['coverage'])} covered as requested; "
        f"a picture every {plan['interval_s']:.2f} s, exposed {1e3 * plan['exposure_s']:.2g} ms; "
        f"map in {folder / 'map.png'}, files for vehicles in {folder / 'exports'}"
    )
    return text, plan


def _fly_summary(folder: Path) -> Summary:
    flight = FlightRecord.read(folder / "flight.json")
    line = flight.on_lines
    mission = flight.mission
    how = flight.controller if mission is None else f"{mission.file} as {mission.follower} flies it"
    promised = (
        ""
        if mission is None
        else f" (the plan's certificate: {share(mission.planned.share_at_overlap)}; "
        f"{mission.line_ends_overshot} of {mission.line_ends} line ends overshot)"
    )
    text = (
        f"{flight.vehicle} with {how}: {flight.ending}, {count(flight.stations, 'station')} "
        f"({flight.stations_planned} planned) in {flight.duration_s / 60:.0f} min; on lines "
        f"{_metres(line.cross_track_rms_m)} cross-track rms (the control's part "
        f"{_metres(line.believed_cross_track_rms_m)}; {_metres(line.cross_track_worst_m)} at most, "
        f"of {_metres(flight.allowed_cross_track_m)} allowed), heading "
        f"{_degrees(line.heading_rms_deg)} rms; roll in turns to "
        f"{_degrees(flight.in_turns.roll_worst_deg)}; "
        f"{_metres(flight.min_clearance_m)} above the sea floor at least; "
        f"{sum(flight.energy_wh.values()):.1f} Wh; "
        f"{share(flight.coverage.share_at_overlap)} of the area covered as requested{promised}, "
        f"{share(flight.coverage.every_camera_share)} seen by every camera; "
        f"plots in {folder / 'track.png'}"
    )
    return text, flight.to_json()


_MAX_MISSED_SHARE = 0.05
"""Of the planned pictures, missed or off their lines: neighbouring lines overlap by more."""


def _fly_shortfall(folder: Path) -> str:
    flight = FlightRecord.read(folder / "flight.json")
    if flight.ending != "complete":
        return f"the flight ended early: {flight.ending}"
    outside, allowed_m = flight.outside_allowed, flight.allowed_cross_track_m
    if outside is None or allowed_m is None:  # of a version that did not look
        return ""
    outside_m = allowed_m if outside.allowed_m is None else outside.allowed_m
    if outside.worst_m > outside_m:
        return (
            f"{flight.vehicle} left the allowed area by {outside.worst_m:.2f} m, more than the "
            f"{outside_m:.2f} m that were to be expected"
        )
    planned = flight.stations_planned
    missed = max(planned - flight.stations, 0) + flight.stations_off_line
    if missed > _MAX_MISSED_SHARE * planned:
        return (
            f"{missed} of {planned} pictures were missed or taken more than {allowed_m:.2f} m off "
            "their lines"
        )
    return ""


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f} deg"


def _image_inputs(workspace: Path) -> list[Path]:
    flight = workspace / "flight"
    return [
        workspace / "plan" / "plan.json",
        flight / "triggers.csv",
        flight / "navigation.csv",
        flight / "truth" / "track.csv",
    ]


def _pictures_summary(folder: Path) -> Summary:
    pictures = len(read_manifest(folder / "manifest.csv"))
    return f"{count(pictures, 'picture')} in {folder}", {"pictures": pictures}


PLAN = StageSpec(
    name="plan",
    folder="plan",
    command="plan",
    about="lines, stations and camera settings that image the area",
    version=16,
    work="missions.plan.run:run_plan",
    takes=(WHOLE,),
    settings={
        "name": "name",
        "area": "area",
        "camera": "camera",
        "water": without("water", "n_water_sigma"),
        "plan": "plan",
        "sea": "sea",
        "vehicle": without("vehicle", "dive", "mission_file"),
        "datum_given": "area.datum_given",
        "strobes": only("imaging", "strobe_lumens", "strobe_beam_deg", "strobes_body_m"),
    },
    setting_files=(
        "area.files",
        "area.bathymetry_file",
        "sea.current_file",
        "vehicle.coefficients_file",
        "vehicle.file",
    ),
    summary=_plan_summary,
    simulated=True,
    products={
        "plan.json": "the plan, for the next stages",
        "settings.txt": "every setting with its equation and limit",
        "exports": "the plan for vehicles",
    },
    reported=("plan.json",),
)


FLY = StageSpec(
    name="fly",
    folder="flight",
    command="fly",
    about="the plan flown by a simulated vehicle",
    version=10,
    work="missions.fly.run:run_fly",
    takes=("seed", "vehicle", "sea", "navigation", "camera", "water", "seafloor", "area", "plan"),
    needs=("plan",),
    settings={
        "seed": "seed",
        "vehicle": without("vehicle", "coefficients_file", "mission_file"),
        "sea": without("sea", "current_file"),
        "navigation": "navigation",
        "seafloor": "seafloor",
        "seafloor_depth_m": "area.seafloor_depth_m",
        "plan": "plan",
        "position_body_m": "camera.position_body_m",
        "dvl_position_body_m": "camera.dvl_position_body_m",
    },
    setting_files=(
        "area.bathymetry_file",
        "sea.current_file",
        "vehicle.coefficients_file",
        "vehicle.file",
        "vehicle.mission_file",
    ),
    inputs=lambda workspace: [workspace / "plan" / "plan.json"],
    summary=_fly_summary,
    shortfall=_fly_shortfall,
    simulated=True,
    products={
        "triggers.csv": "when pictures are taken",
        "navigation.csv": "where the vehicle believed to be",
        "vehicle.csv": "log of the vehicle",
        "bag": "the same as a ROS 2 bag",
    },
    reported=("flight.json",),
)


POOL = StageSpec(
    name="pool",
    folder="pool",
    command="image",
    about="rendered pictures of a board, to calibrate from",
    version=5,
    work="missions.acquire.run:run_pool",
    takes=("camera", "water", "imaging", "seed"),
    settings={
        "seed": "seed",
        "camera": "camera",
        "n_water": "water.n_water",
        "board": BoardRecord().to_json(),
        "imaging": only("imaging", "scale", "image_format", "samples", "noise", "pool_views"),
    },
    summary=_pictures_summary,
    resumes=True,
    simulated=True,
    products={"manifest.csv": "the pictures", "board.json": "the board"},
)


IMAGE = StageSpec(
    name="image",
    folder="images",
    command="image",
    about="the pictures: rendered, or real ones (`import-images`)",
    version=6,
    work="missions.acquire.run:run_images",
    takes=("camera", "water", "imaging", "seafloor", "plan.altitude_m", "area", "seed"),
    needs=("plan", "fly"),
    settings={
        "seed": "seed",
        "seafloor_depth_m": "area.seafloor_depth_m",
        "margins": only("plan", "altitude_m", "run_in_m", "turn_radius_m", "margin_m"),
        "camera": "camera",
        "water": without("water", "n_water_sigma"),
        "seafloor": "seafloor",
        "imaging": without("imaging", "pool_views"),
    },
    setting_files=("area.bathymetry_file",),
    inputs=_image_inputs,
    summary=_pictures_summary,
    resumes=True,
    simulated=True,
    products={"manifest.csv": "the pictures, with time and navigation"},
    reported=("manifest.csv",),
)


STAGES = (PLAN, FLY, POOL, IMAGE)
"""In the order in which they run."""
