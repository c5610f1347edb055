"""The summary of a tank as text."""

from collections.abc import Mapping
from typing import Any

from alice_survey.base.text_table import text_table

_POSES = {
    "poses_from_reference_points": "reference points",
    "poses_refined": "refined",
    "poses_refined_on_other_half": "refined, held out",
}
_POINTS = {"least_squares": "least squares", "midpoint": "midpoint of rays"}


def tank_text(summary: Mapping[str, Any]) -> str:
    """What `tank.json` says, to read."""
    lines = [_lens_line(name, lens) for name, lens in summary["lenses"].items()]
    lines += [_camera_line(name, camera) for name, camera in summary["cameras"].items()]
    told = summary["detections"]
    lines.append(
        f"detections: {told['points']} points, {told['in_water']} of them in the water; "
        f"{told['without_partner']} without a partner, {told['not_numbers']} no numbers, "
        f"{told['repeated']} repeated"
    )
    lines += ["", _error_table(summary), ""]
    pixels, whole = summary["sigma_mm"]["of_pixels"], summary["sigma_mm"]["with_cameras"]
    lines.append(
        f"typical sigma of a point (x, y, z): {_triple(whole)} mm; of its pixels alone "
        f"({told['sigma_px']:.2f} px, from how well rays meet): {_triple(pixels)} mm"
    )
    lines += [_lag_line(lag) for lag in summary["lags"]]
    return "\n".join(lines)


def _lens_line(name: str, lens: Mapping[str, Any]) -> str:
    chosen = next(model for model in lens["models"] if model["name"] == lens["model"])
    folding = sum(model["folds"] for model in lens["models"])
    return (
        f"lens ({name}): '{lens['model']}' of {len(lens['models'])} models, {folding} of which "
        f"fold back within the frame; {chosen['rms_px']:.2f} px rms over {lens['views']} views, "
        f"{chosen['held_out_px']:.2f} px held out; {len(lens['rejected'])} views left out"
    )


def _camera_line(name: str, camera: Mapping[str, Any]) -> str:
    x, y, z = camera["position_world_m"]
    return (
        f"{name}: at ({x:.4f}, {y:.4f}, {z:.4f}) m, {camera['port_distance_m'] * 1e3:.1f} mm "
        f"before its interface, {camera['tilt_deg']:.1f} deg off its normal; reference points "
        f"missed by {camera['reference_rms_px']:.1f} px rms"
    )


def _error_table(summary: Mapping[str, Any]) -> str:
    cameras = list(summary["cameras"])
    header = ["poses", "points", *(f"{name} median" for name in cameras), "sum median", "sum mean"]
    rows = []
    for poses, kinds in summary["error_px"].items():
        for kind, misses in kinds.items():
            each = [f"{misses['median'][name]:.2f}" for name in cameras]
            sums = [f"{misses['sum_median']:.2f}", f"{misses['sum_mean']:.2f}"]
            rows.append([_POSES[poses], _POINTS[kind], *each, *sums])
    return "reprojection error, px\n" + text_table(header, rows)


def _lag_line(lag: Mapping[str, Any]) -> str:
    return (
        f"{lag['camera']} is {lag['frames']:+.2f} +/- {lag['sigma']:.2f} frames later than the "
        f"first camera, from {lag['points']} detections with a known speed"
    )


def _triple(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
