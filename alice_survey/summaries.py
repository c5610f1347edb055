"""What each stage has found, in a line to read and as JSON values."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from alice_survey.base.artefacts import read_json

Summary = tuple[str, dict[str, Any]]


def _plan(folder: Path) -> Summary:
    plan = read_json(folder / "plan.json")
    dives = len(plan["dives"])
    text = (
        f"{len(plan['lines'])} lines, {plan['stations']} stations, {plan['length_m']:.0f} m, "
        f"{plan['duration_s'] / 60:.0f} min, {plan['energy_wh']:.0f} Wh in {dives} "
        f"dive{'s' if dives > 1 else ''}; overlap {plan['forward_overlap']:.0%} forward, "
        f"{plan['side_overlap']:.0%} side, {plan['coverage']:.1%} covered as asked; a picture "
        f"every {plan['interval_s']:.2f} s, exposed {1e3 * plan['exposure_s']:.2g} ms; map in "
        f"{folder / 'map.png'}, files for vehicles in {folder / 'exports'}"
    )
    return text, plan


def _flight(folder: Path) -> Summary:
    found = read_json(folder / "flight.json")
    line, turn = found["on_lines"], found["in_turns"]
    text = (
        f"{found['vehicle']} with {found['controller']}: {found['ending']}, {found['stations']} of "
        f"{found['stations_planned']} stations in {found['duration_s'] / 60:.0f} min; on lines "
        f"{_metres(line['cross_track_rms_m'])} cross-track rms (the control's part "
        f"{_metres(line['believed_cross_track_rms_m'])}), heading "
        f"{_degrees(line['heading_rms_deg'])} rms; roll in turns to "
        f"{_degrees(turn['roll_worst_deg'])}; {sum(found['energy_wh'].values()):.1f} Wh; "
        f"{found['coverage']['share_at_overlap']:.1%} of the area covered as asked, "
        f"{found['coverage']['every_camera_share']:.1%} seen by every camera; "
        f"plots in {folder / 'track.png'} and {folder / 'vehicle.png'}"
    )
    return text, found


def _metres(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.1f} deg"


def _pictures(folder: Path) -> Summary:
    count = len((folder / "manifest.csv").read_text().splitlines()) - 1
    return f"{count} pictures in {folder}", {"pictures": count}


def _calibration(folder: Path) -> Summary:
    found = read_json(folder / "calibration.json")
    text = (
        f"{found['views']} views, {found['rms_px']:.3f} px rms; rig in {folder / 'rig.json'}, "
        f"report in {folder / 'report.html'}"
    )
    return text, {key: found[key] for key in ("views", "rms_px", "worst_px")}


def _sparse(folder: Path) -> Summary:
    found = read_json(folder / "registration.json")
    text = (
        f"{found['registered']} of {found['total']} pictures registered, "
        f"{found['mean_reprojection_px']:.2f} px; {found['scale_source']}"
    )
    return text, found


def _dense(folder: Path) -> Summary:
    found = read_json(folder / "cloud.json")
    return f"{found['points']} points; surface in {folder / 'dem.tif'}", found


def _mosaic(folder: Path) -> Summary:
    found = read_json(folder / "mosaic.json")
    text = f"{found['width_px']} x {found['height_px']} px in {folder / 'mosaic.tif'}"
    return text, found


def _mesh(folder: Path) -> Summary:
    found = read_json(folder / "mesh.json")
    text = (
        f"{found['triangles']} triangles, {found['textured_share']:.0%} textured, in "
        f"{folder / 'mesh.glb'}"
    )
    return text, found


def _evaluation(folder: Path) -> Summary:
    found = read_json(folder / "score.json")
    rows = [
        (f"{group}.{name}", value) for group, part in found.items() for name, value in part.items()
    ]
    table = "\n".join(f"  {name:44} {value}" for name, value in rows)
    return f"score in {folder / 'score.json'}\n{table}", found


def _report(folder: Path) -> Summary:
    found = read_json(folder / "report.json")
    said = "\n".join(f"  {question}: {answer}" for question, answer in found["summary"].items())
    return f"{folder / 'report.html'} and {folder / 'report.pdf'}\n{said}", found


SUMMARIES: dict[str, Callable[[Path], Summary]] = {
    "plan": _plan,
    "flight": _flight,
    "pool": _pictures,
    "images": _pictures,
    "calibration": _calibration,
    "sparse": _sparse,
    "dense": _dense,
    "mosaic": _mosaic,
    "mesh": _mesh,
    "evaluation": _evaluation,
    "report": _report,
}
"""By stage: takes its folder."""
