"""Bundle adjustment: cameras, lenses and points moved together until the photos are explained best.

Symbols: r_ij distance in pixels of sighting i of point j from the point's projection; s its typical size. Minimised is
    sum rho(r_ij^2),   rho(x) = c^2 log(1 + x / c^2),   c = 2 s
so that the few matches that are wrong count little (Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section
3.3). With plain squares they pull a camera of 67 real ones 0.36 % of its distance away, with this 0.28 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pipeline.colmap import pycolmap
from pipeline.transforms import F64

ROBUST = 2.0  # c / s: less wastes what good matches say, more lets wrong ones speak
MIN_SCALE = 0.1  # pixels: exact matches, which only drawn ones are, must not make the loss a spike
TOLERANCE = 1e-6  # of the cost: ten times less moves no camera by a hundredth of its error


@dataclass(frozen=True, slots=True)
class Refine:
    """What bundle adjustment may move, besides poses and points. principal_point: auto: where the photos tell it."""

    focal: bool = True
    distortion: bool = True
    principal_point: Literal["auto", "yes", "no"] = "auto"


def settle(reconstruction: Any, refine: Refine, *, principal_point: bool) -> None:
    """Everything is moved once more, wrong matches without weight. In place."""
    options, config, _ = _problem(reconstruction)
    options.refine_focal_length, options.refine_extra_params = refine.focal, refine.distortion
    options.refine_principal_point = principal_point
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    reconstruction.update_point_3d_errors()


def settle_near(reconstruction: Any, centres: dict[int, F64], deviation: float) -> None:
    """Poses and points are moved, lenses stay, and each camera's centre is held near a known one. In place.

    centres: (3,) by image id. deviation: standard deviation of each coordinate, units of the world. Sightings enter the
    sum in pixels and not in their own deviation s, so the prior's has to be divided by s to keep the ratio of the two.
    """
    options, config, noise = _problem(reconstruction)
    options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
    priors = []
    for number, centre in sorted(centres.items()):
        if config.has_image(number):
            priors.append(pycolmap.PosePrior(
                corr_data_id=reconstruction.images[number].data_id, position=centre,
                position_covariance=np.eye(3) * (deviation / noise) ** 2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            ))  # fmt: skip
    own = pycolmap.PosePriorBundleAdjustmentOptions()
    own.alignment_ransac.random_seed = 0
    # the worlds agree but for the cameras' own errors, so that all centres count; by itself COLMAP would drop every
    # prior without a word where most are off by more than the deviation
    own.alignment_ransac.max_error = 1e3 * max(deviation, float(np.ptp(np.stack(list(centres.values())), axis=0).max()))
    pycolmap.create_pose_prior_bundle_adjuster(options, own, config, priors, reconstruction).solve()
    reconstruction.update_point_3d_errors()


def _problem(reconstruction: Any) -> tuple[Any, Any, float]:
    """Options, the placed photos, and s: the median error of the points so far."""
    reconstruction.update_point_3d_errors()
    errors = [p.error for p in reconstruction.points3D.values()]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    typical = max(float(np.median(errors)), MIN_SCALE) if errors else 1.0
    options.ceres.loss_function_scale = ROBUST * typical
    options.ceres.solver_options.function_tolerance = TOLERANCE
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for number, image in reconstruction.images.items():
        if image.has_pose:
            config.add_image(number)
    return options, config, typical
