"""Sections of a calibration report: its tests, what the views cover, what was rejected."""

from camera_calib.judge import plots_of_checks as plots
from camera_calib.judge.fit_quality import TILTED_DEG
from camera_calib.judge.judgement import Judgement
from camera_calib.judge.page import Figure, Section, Table


def hold_out_section(judged: Judgement) -> Section:
    """Views that took no part, and calibrations from halves of the views."""
    score = judged.hold_out
    if score is None:
        return Section(
            title="Hold-out test",
            text=("Not done: too few views to leave some out and calibrate from the rest.",),
        )
    figures = [
        Figure(
            png=plots.plot_hold_out(judged),
            title="Views that took no part",
            alt="Lollipops: rms of views used and of views held out",
            shows="The rig is calibrated again without the diamonds, whose poses are then found "
            f"with the rig held. They fit to {score.rms_px:.3f} px rms, {score.expected_px:.3f} px "
            "is what noise and covariance promise.",
            good="Held out near the dashed line, and near the used ones.",
            otherwise="Clearly above: the model fits the views it was given and not the camera. "
            "Free fewer parameters, or take more and more varied views.",
        )
    ]
    if any(camera.halves is not None for camera in judged.cameras.values()):
        figures.append(
            Figure(
                png=plots.plot_halves(judged),
                title="Two halves of the views",
                alt="Maps and arrows: difference of projection between two calibrations",
                shows="Two calibrations, from every other view each: how far apart they project "
                f"at {judged.working_range_m:.3g} m, after the best pose between them.",
                good="No more than about twice the expected rms in the titles.",
                otherwise="Much more: the sigmas are too small, as the model is wrong or the "
                "target moved; do not trust the maps above.",
            )
        )
    return Section(title="Hold-out test", figures=figures)


def lengths_section(judged: Judgement) -> Section:
    """Lengths on the target, triangulated."""
    rows = []
    for lengths, which in ((judged.lengths, "used"), (judged.held_lengths, "held out")):
        if lengths is None or not len(lengths.true_m):
            continue
        scale, scale_sigma = lengths.scale_ppm()
        for long, kind in ((True, "long"), (False, "neighbours")):
            rms, expected = lengths.rms_m(long)
            at = lengths.long == long
            scaled = f"{scale:+.0f} +/- {scale_sigma:.0f}" if long and scale == scale else ""
            size = f"{1e3 * lengths.true_m[at].min():.0f} to {1e3 * lengths.true_m[at].max():.0f}"
            rows.append(
                (
                    which,
                    kind,
                    f"{at.sum()}",
                    size,
                    f"{1e3 * rms:.3f}",
                    f"{1e3 * expected:.3f}",
                    scaled,
                )
            )
    figures = []
    if rows:
        figures.append(
            Figure(
                png=plots.plot_lengths(judged),
                title="Lengths on the target",
                alt="Scale error of each view against distance, and histogram of length errors",
                shows="Points seen by two cameras are triangulated, view by view, and their "
                "distances compared with the target's: scale error of the long ones (left), and "
                "all errors of long ones over what noise gives (right).",
                good="Scatter about zero without a trend, and bars under the curve.",
                otherwise="An offset is a wrong target size or baseline; a trend with distance a "
                "wrong rotation between the cameras, port or focal length.",
            )
        )
    return Section(
        title="Lengths",
        text=(
            "The target gives the scale of the rig, so used views prove little of scale as such; "
            "held-out views, and the trend with distance, are independent.",
        ),
        figures=figures,
        tables=[
            Table(
                title="Length errors",
                header=("views", "lengths", "count", "mm", "rms mm", "by noise mm", "scale ppm"),
                rows=rows,
                wide=True,
            )
        ],
    )


def homographies_section(judged: Judgement) -> Section:
    """What homographies leave."""
    if all(camera.homography is None for camera in judged.cameras.values()):
        return Section(
            title="Homographies",
            text=("Not done: the target is not flat, or no view has enough points.",),
        )
    return Section(
        title="Homographies",
        text=(
            "A test that needs no truth: with lens and port undone, each picture of a flat target "
            "is a plane seen by a pinhole, so a homography fits it to the noise. A flat port has "
            "no single centre; each ray is followed to the target's own distance before the "
            "pinhole looks.",
        ),
        figures=[
            Figure(
                png=plots.plot_homographies(judged),
                title="What homographies leave",
                alt="Lines: rms and mean outward part of homography residuals against radius",
                shows="Residuals of one homography per picture, against the radius.",
                good="On the dashed lines, which are the inner points' level carried outwards.",
                otherwise="A rise or a bow towards the edge is an error of the lens or port model "
                "that poses cannot hide; also a bent target, which then bows all alike.",
            )
        ],
    )


def coverage_section(judged: Judgement) -> Section:
    """Where points fell, and how the target was held."""
    rows = []
    for name, camera in judged.cameras.items():
        views, reach = camera.spread, camera.coverage.corner_reach
        rows.append(
            (
                name,
                *(f"{100 * r:.0f}%" for r in reach.values()),
                f"{camera.coverage.empty_share:.0%}",
                f"{views.range_m.min():.2f} to {views.range_m.max():.2f}",
            )
        )
    bare = [
        f"{name}: no points near the {', '.join(c.coverage.uncovered)} of the frame."
        for name, c in judged.cameras.items()
        if c.coverage.uncovered
    ]
    return Section(
        title="Coverage",
        text=bare or ["Points come near all corners of all frames."],
        figures=[
            Figure(
                png=plots.plot_coverage(judged),
                title="Where points fell",
                alt="Counts of points by cell of each frame; corners without points hatched",
                shows="Points seen by cell. In hatched corners there are none: distortion is "
                "guessed there.",
                good="All cells filled, corners too.",
                otherwise="Hold the target so that it fills the empty parts, partly out of the "
                "frame if it can be read so (ChArUco, AprilTags).",
            ),
            Figure(
                png=plots.plot_spread(judged),
                title="How the target was held",
                alt="Scatter: tilts of the target, and tilt against distance",
                shows=f"Tilts about both axes of the camera; the shade is below {TILTED_DEG:g} "
                "degrees.",
                good="Points in all four quarters beyond the shade, at near and far distances.",
                otherwise="Tilt the target both ways, and take near and far views: they part focal "
                "length, port distance and centre.",
            ),
        ],
        tables=[
            Table(
                title="How far towards each corner points were seen; empty cells; distances m",
                header=(
                    "camera",
                    "top left",
                    "top right",
                    "bottom left",
                    "bottom right",
                    "empty",
                    "distances",
                ),
                rows=rows,
                wide=True,
            )
        ],
    )


def rejections_section(judged: Judgement) -> Section:
    """What took no part, and why."""
    rows = [
        (r.view, r.camera, f"{r.points}" if r.points else "whole picture", r.reason)
        for r in judged.calibration.rejections
    ]
    return Section(
        title="Rejected",
        text=("Pictures, and corners of them, that took no part.",)
        if rows
        else ("No picture and no corner was rejected.",),
        tables=[Table(title="", header=("view", "camera", "points", "why"), rows=rows, wide=True)]
        if rows
        else [],
    )
