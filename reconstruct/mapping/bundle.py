"""COLMAP's bundle adjustment as used here: poses and points move, rig and cameras do not.

It takes full Gauss-Newton steps, since it starts near its end: COLMAP's own first trust region
costs ten times the iterations along a block's weak directions.
"""

import pycolmap

from reconstruct.mapping.robust import loss_scale

_TRUST = 1e12
"""First radius of the trust region: no bound."""
FULLY, ROUGHLY = 1e-4, 1e-2
"""Relative changes of the cost at which an adjustment ends: where none follows, and others.
The last steps of a robust loss are many and small: in a block of 25 stations with camera errors of
0.22 mm, an end 10,000 times tighter takes 75 more of them and moves no camera by 0.007 mm."""
_EVERY_SIZE = 1_000_000_000
"""Pictures up to which an adjustment is solved directly."""


def direct_solver(options: pycolmap.BundleAdjustmentOptions) -> pycolmap.BundleAdjustmentOptions:
    """Make an adjustment quiet, of one thread and solved directly, in place, and return it.

    Sums of several threads are not the same twice. Beyond 1,000 pictures COLMAP would change to
    conjugate gradients, whose steps along a block's weak directions are so short that the cost
    seems to have converged: of 1,020 pictures 26 mm of bend were left where the optimum has 7 mm.
    The sparse factor of the reduced system is faster there as well (0.5 s for 2.3 s).
    """
    options.print_summary = False
    options.ceres.max_num_images_direct_sparse_cpu_solver = _EVERY_SIZE
    options.ceres.solver_options.num_threads = 1
    return options


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
