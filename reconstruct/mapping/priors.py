"""A last adjustment that lets positions of navigation straighten what pictures alone let bend.

A single line of pictures, calibrated and on a rigid rig, still bows slowly along its length;
navigation does not. COLMAP's adjustment with position priors first fits the model to the priors by
a similarity, and would so take the scale from navigation: here the priors are made to agree with
the model's scale first, and the rig's known baseline is restored afterwards.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pycolmap

from alice_survey.base.errors import warn
from alice_survey.base.frames import Array, Datum, rotation_from_attitude
from alice_survey.base.manifest import ImageRecord
from camera_calib.approximation.pinhole_warp import PinholeWarp
from camera_calib.rig import Rig
from reconstruct.mapping.arrays import first_pictures
from reconstruct.mapping.bundle import FULLY, all_pictures, held_options
from reconstruct.mapping.mapper import Mapped, model_baseline, scale_model
from reconstruct.mapping.robust import pixel_sigma
from reconstruct.matching.pairs import positions_ned

Adjust = Callable[[Mapped, float], Mapped]
"""Adjusts a model, rig and cameras held, to a relative change of the cost; the one given is not
changed."""

_LEAST_STATIONS = 5
_WORST_GROWTH = 1.05
"""Priors may raise the mean reprojection error by this factor at most, else they are not used."""


def pinhole_positions(
    records: Sequence[ImageRecord], rig: Rig, warps: Mapping[str, PinholeWarp], datum: Datum
) -> tuple[Array, Array]:
    """The pinholes' centres by navigation.

    Returns:
        (N, 3) positions in NED and their sigmas, both metres; NaN where position, attitude or a
        sigma is unknown.
    """
    bodies = positions_ned(records, datum)
    positions, sigmas = np.full((len(records), 3), np.nan), np.full((len(records), 3), np.nan)
    for i, record in enumerate(records):
        sigma = np.array(
            [record.sigma_horizontal_m, record.sigma_horizontal_m, record.sigma_depth_m]
        )
        turn = np.deg2rad(max(record.sigma_attitude_deg, record.sigma_heading_deg))
        if not (record.has_position and record.has_attitude and np.all(sigma > 0) and turn > 0):
            continue
        attitude = np.deg2rad([record.roll_deg, record.pitch_deg, record.heading_deg])
        body_from_pinhole = (
            rig.body_from_cam(record.camera) * warps[record.camera].pinhole_from_cam.inv()
        )
        lever = body_from_pinhole.translation
        positions[i] = bodies[i] + rotation_from_attitude(*attitude).apply(lever)
        sigmas[i] = np.hypot(sigma, turn * np.linalg.norm(lever))
    return positions, sigmas


def adjust_freely(mapped: Mapped, tolerance: float = FULLY) -> Mapped:
    """Adjust all poses and points, without priors.

    A rig fixes the scale, so that one station's pose is all that is held; else two pictures are.
    """
    model = pycolmap.Reconstruction(mapped.model)
    config = all_pictures(model)
    if np.isfinite(mapped.baseline):
        config.set_constant_rig_from_world_pose(min(model.reg_frame_ids()))
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(
        held_options(pixel_sigma(model), tolerance), config, model
    ).solve()
    model.update_point_3d_errors()
    return replace(mapped, model=model)


class NavigationAdjuster:
    """Adjusts models with the positions of navigation, where they are given and agree."""

    def __init__(
        self,
        records: Sequence[ImageRecord],
        rig: Rig,
        warps: Mapping[str, PinholeWarp],
        datum: Datum | None,
    ) -> None:
        """Take the positions of navigation.

        Args:
            records: pictures; number i has the id i + 1 in the model.
            rig: cameras.
            warps: by camera.
            datum: of the positions; None where there are none.
        """
        self._records = records
        self._given = None if datum is None else pinhole_positions(records, rig, warps, datum)
        self._used = False

    def __call__(self, mapped: Mapped, tolerance: float = FULLY) -> Mapped:
        """The adjusted model."""
        if self._given is not None and mapped.scaled:
            refined = refine_with_positions(
                mapped, self._records, *self._given, tolerance=tolerance
            )
            self._used = refined is not mapped
            if self._used:
                return refined
            self._given = None  # said once
        return adjust_freely(mapped, tolerance)

    @property
    def sigmas(self) -> Array | None:
        """(N, 3) sigmas of positions that shaped the last model, along its axes; None without."""
        return self._given[1] if self._used and self._given is not None else None


def refine_with_positions(
    mapped: Mapped,
    records: Sequence[ImageRecord],
    positions: Array,
    sigmas: Array,
    *,
    tolerance: float = FULLY,
) -> Mapped:
    """Adjust a model on a known rig once more, with robust position priors.

    Args:
        mapped: model whose scale comes from the rig; picture i of `records` has the id i + 1.
        records: pictures.
        positions: (N, 3) of the pinholes' centres in NED; NaN where unknown.
        sigmas: (N, 3); the same for these.
        tolerance: relative change of the cost at which it ends.

    Returns:
        The adjusted model in a new gauge; the one given where positions are too few or disagree
        with the pictures.
    """
    model = pycolmap.Reconstruction(mapped.model)
    model.update_point_3d_errors()
    before = model.compute_mean_reprojection_error()
    # One picture of each frame, since navigation measured it once.
    known = sorted(first_pictures(model, positions + sigmas).values())
    if len(known) < _LEAST_STATIONS:
        return mapped
    given = positions[[number - 1 for number in known]]
    # The adjuster's constructor aligns the model with the priors robustly, outliers left out: its
    # scale is taken out of the priors, so that the second one changes it no more.
    pixel = pixel_sigma(model)
    trial = pycolmap.Reconstruction(model)
    _adjuster(trial, _priors(trial, known, given, sigmas / pixel), pixel, tolerance)
    middle = given.mean(axis=0)
    given = middle + (given - middle) * mapped.baseline / model_baseline(trial)
    summary = _adjuster(
        model, _priors(model, known, given, sigmas / pixel), pixel, tolerance
    ).solve()
    model.update_point_3d_errors()
    after = model.compute_mean_reprojection_error()
    if not (summary.is_solution_usable() and after <= _WORST_GROWTH * before):
        warn(
            f"positions of navigation disagree with the pictures (reprojection {before:.2f} px "
            f"without, {after:.2f} px with them): they place the model but do not shape it"
        )
        return mapped
    factor = mapped.baseline / model_baseline(model)
    scale_model(model, factor)
    return replace(mapped, model=model, rig_factor=mapped.rig_factor * factor)


def _priors(
    model: pycolmap.Reconstruction, known: Sequence[int], given: Array, sigmas: Array
) -> list[pycolmap.PosePrior]:
    return [
        pycolmap.PosePrior(
            pose_prior_id=number,
            corr_data_id=model.images[number].data_id,
            position=position,
            position_covariance=np.diag(sigmas[number - 1] ** 2),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for number, position in zip(known, given, strict=True)
    ]


def _adjuster(
    model: pycolmap.Reconstruction,
    priors: Sequence[pycolmap.PosePrior],
    pixel: float,
    tolerance: float,
) -> pycolmap.BundleAdjuster:
    """COLMAP's: it takes pixels to have unit sigma, so that those of `priors` are over `pixel`."""
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    prior_options.ceres.prior_position_loss_scale *= pixel
    prior_options.alignment_ransac.random_seed = 1
    prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    return pycolmap.create_pose_prior_bundle_adjuster(
        held_options(pixel, tolerance), prior_options, all_pictures(model), priors, model
    )
