"""COLMAP's bundle adjustment as used here: poses and points move, rig and cameras do not.

It takes full Gauss-Newton steps, since it starts near its end: COLMAP's own first trust region
costs ten times the iterations along a block's weak directions.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap

from reconstruct.mapping.mapper import Mapped
from reconstruct.mapping.robust import loss_scale, pixel_sigma
from reconstruct.mapping.solver import direct_solver

Adjust = Callable[[Mapped, float], Mapped]
"""Adjusts a model, rig and cameras held, to a relative change of the cost; the one given is not
changed."""

_TRUST = 1e12
"""First radius of the trust region: no bound."""
FULLY, ROUGHLY = 1e-4, 1e-2
"""Relative changes of the cost at which an adjustment ends: the final one, and others.
The last steps of a robust loss are many and small: in a block of 25 stations with camera errors of
0.22 mm, an end 10,000 times tighter takes 75 more of them and moves no camera by 0.007 mm."""


def held_options(sigma_px: float, tolerance: float = FULLY) -> pycolmap.BundleAdjustmentOptions:
    """Options that hold cameras and rig, for keypoints of this sigma and some that are wrong."""
    options = direct_solver(pycolmap.BundleAdjustmentOptions())
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_scale(sigma_px)
    options.refine_sensor_from_rig = False
    options.refine_focal_length = options.refine_extra_params = False
    solver = options.ceres.solver_options
    solver.initial_trust_region_radius = _TRUST
    solver.function_tolerance = tolerance
    return options


def all_pictures(model: pycolmap.Reconstruction) -> pycolmap.BundleAdjustmentConfig:
    """The part of a model to adjust: all of it."""
    config = pycolmap.BundleAdjustmentConfig()
    for number, image in sorted(model.images.items()):
        if image.has_pose:
            config.add_image(number)
    return config


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


def move_points(model: pycolmap.Reconstruction, sigma_px: float) -> None:
    """Put points, in place, where the keypoints have them: poses, rig and cameras are held.

    Args:
        model: to change.
        sigma_px: of keypoints.
    """
    config = all_pictures(model)
    for frame in sorted(model.reg_frame_ids()):
        config.set_constant_rig_from_world_pose(frame)
    pycolmap.create_default_bundle_adjuster(held_options(sigma_px), config, model).solve()
