"""The stage that calibrates: what it depends on, makes and says."""

from pathlib import Path

from alice_survey.core.artefacts import read_json
from alice_survey.core.records import CalibrationRecord
from alice_survey.core.stages import StageSpec, Summary, without
from alice_survey.kit.words import count


def _calibrate_inputs(workspace: Path) -> list[Path]:
    pool = workspace / "pool"
    air = [pool / "air"] if (pool / "air").exists() else []
    return [pool / name for name in ("manifest.csv", "board.json", "left", "right")] + air


def _calibrate_summary(folder: Path) -> Summary:
    found = CalibrationRecord.read(folder / "calibration.json")
    text = (
        f"{count(found.views, 'view')}, {found.rms_px:.3f} px rms; rig in {folder / 'rig.json'}, "
        f"report in {folder / 'report.html'}"
    )
    return text, {"views": found.views, "rms_px": found.rms_px, "worst_px": found.worst_px}


def calibration_shortfall(folder: Path) -> str:
    """The first bad verdict on a calibration; empty where there is none."""
    verdicts = read_json(folder / "report.json")["verdicts"]
    return next((one["text"] for one in verdicts if one["level"] == "bad"), "")


CALIBRATE = StageSpec(
    name="calibrate",
    folder="calibration",
    command="calibrate",
    about="the rig, from the pictures of the board",
    version=11,
    work="camera_calib.calibrate.from_pictures:run_calibrate",
    takes=("camera", "water"),
    needs=("pool",),
    settings={"camera": "camera", "water": without("water", "n_water_sigma")},
    inputs=_calibrate_inputs,
    summary=_calibrate_summary,
    shortfall=calibration_shortfall,
    simulated=True,
    products={
        "rig.json": "cameras, ports and baseline with their covariance",
        "report.html": "how good the calibration is",
    },
    reported=("report.json",),
)
