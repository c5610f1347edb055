"""How often navigation shows that a model is bent: the power of the test for doming.

    python -m benchmarks.bend_power --work FOLDER [--flights 20] [--plot FILE] [--quick]
        [--json FILE]

The true stations of flights of Caesarea, bent along the block by a sag, are placed by the logs of
those flights as a model is, and judged as `mapping.json` is: a bend counts as seen where it is
beyond three of its sigmas and larger than a ground pixel. The pixels are those of the camera, and
of an eighth of its resolution. FOLDER keeps the flights.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from alice_survey.core.frames import Array
from alice_survey.kit.figure import figure_style, new_figure, save_figure
from benchmarks.bend_survey import Fault, FlownTrack, fly, logged, records_of
from benchmarks.figures import Figure, Findings, Goal, add_options, hand_over
from benchmarks.machine import heading, machine
from camera_calib.rig import design_rig
from missions.exposure.footprints import pixel_on_floor_m
from reconstruct.placing.alignment import Bend, Similarity, bend_modes, level, quadratic
from reconstruct.placing.fit import fit_navigation

BENDS_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0)
_FIRST_SEED = 11
_SCALES = (1, 8)
_SEEN_MM, _SHARE, _FALSE = 8.0, 0.9, 0.05


def shown_bend(track: FlownTrack, sag_m: float) -> Bend:
    """The bend along the block that navigation shows of a model bent by a sag."""
    rig = design_rig(track.config.camera, track.config.water)
    mount = rig.body_from_cam(rig.reference)
    true = track.ned_from_body * mount
    places = true.translation
    here = Similarity(scale=1.0, rotation=Rotation.identity(), translation=np.zeros(3))
    _, sizes, _ = quadratic(places[:, :2])
    # A mode goes down where a bend's ends are too high.
    step = -8.0 * sag_m / sizes[0] ** 2 * bend_modes(places, here)[:, :, 0]
    bent = RigidTransform.from_components(
        places + step[:, :3], Rotation.from_rotvec(step[:, 3:]) * true.rotation
    )
    depth_m = np.full(len(places), track.config.area.seafloor_depth_m)
    floor = np.column_stack([places[:, :2], depth_m])
    fit = fit_navigation(
        records_of(track, [rig.reference], logged(track, Fault(), 0)),
        list(bent),
        {rig.reference: mount},
        track.datum,
        level(floor, bent.translation),
        known_scale=1.0,
    )
    assert fit is not None
    return fit.bends[0]


def main() -> None:
    """Print the curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="keeps the flights")
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--plot", type=Path, help="PNG, PDF or SVG to draw")
    add_options(parser, quick="one flight, bends of 0 and 8 mm")
    options = parser.parse_args()
    bends_mm = (0.0, _SEEN_MM) if options.quick else BENDS_MM
    about = machine(("numpy", "scipy"))
    print(f"{heading(about)}\n", flush=True)
    options.work.mkdir(parents=True, exist_ok=True)
    count = 1 if options.quick else options.flights
    flights = [fly(options.work, "caesarea", _FIRST_SEED + k) for k in range(count)]
    found = [[shown_bend(track, sag / 1e3) for track in flights] for sag in bends_mm]
    config = flights[0].config
    camera = design_rig(config.camera, config.water).cameras["left"]
    pixel_m = pixel_on_floor_m(camera, config.plan.altitude_m)
    seen = {
        scale: np.array([[b.significant(scale * pixel_m) for b in row] for row in found]).mean(1)
        for scale in _SCALES
    }
    print("bend, mm   shown, mm   sigma, mm   seen: " + ", ".join(
        f"{1e3 * scale * pixel_m:.1f} mm pixels" for scale in _SCALES))  # fmt: skip
    for k, sag in enumerate(bends_mm):
        shown, sigma = 1e3 * np.array([[b.sag_m, b.sag_sigma_m] for b in found[k]]).T
        shares = "".join(f"{seen[scale][k]:15.0%}" for scale in _SCALES)
        print(
            f"{sag:8.0f}{shown.mean():8.1f} +/- {shown.std():.1f}{np.sqrt((sigma**2).mean()):8.1f}"
            f"{shares}"
        )
    if options.plot is not None:
        _draw(options.plot, bends_mm, {1e3 * s * pixel_m: shares for s, shares in seen.items()})
    figures = [
        Figure(
            name=f"bend of {sag:g} mm seen, pixels of {1e3 * scale * pixel_m:.1f} mm",
            value=float(seen[scale][k]), unit="", goal=_goal(sag),
        )
        for k, sag in enumerate(bends_mm)
        for scale in _SCALES
    ]  # fmt: skip
    sys.exit(hand_over(options, about, Findings(figures=tuple(figures))))


def _goal(sag_mm: float) -> Goal | None:
    if sag_mm == _SEEN_MM:
        return Goal(minimum=_SHARE)
    return Goal(maximum=_FALSE) if sag_mm == 0.0 else None


def _draw(path: Path, bends_mm: tuple[float, ...], seen: dict[float, Array]) -> None:
    sheet = new_figure(3.2, 5.5)
    with figure_style():
        axes = sheet.subplots()
        for pixel_mm, shares in seen.items():
            axes.plot(bends_mm, 100 * shares, "o-", label=f"ground pixel {pixel_mm:.1f} mm")
        axes.set(xlabel="bend along Caesarea's 30 m, mm", ylabel="seen in % of the flights")
        axes.legend()
    save_figure(sheet, path)


if __name__ == "__main__":
    main()
