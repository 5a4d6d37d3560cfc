"""GGX widths alpha of NeuFace's lobe of concentration kappa. There are two, on purpose, because they answer different
questions; at kappa = 10 they are 0.234 and 0.191.

gauge_alpha      for the level of the light in the fit. The light estimate assumes that skin reflects like a GGX lobe of
                 this width under a uniform light. Its level is a convention between the assumed width, the assumed F0
                 and the fitted lobe, tested as a whole against known lights; it is differentiable and valid for every
                 kappa > 0.
best_fit_alpha   for the exported material: the GGX lobe that blurs light most like the fitted one. It comes from a
                 least-squares fit for kappa in KAPPA_RANGE.

One function for both was measured (docs/benchmarks.md, One conversion from kappa to the GGX width). With
best_fit_alpha in the light estimate, the light's level is wrong on a scanned head (7 dB of albedo). With gauge_alpha in
the export, the lobe's reflectance by angle is closer to the fitted one, but it blurs light less like it: undecided.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from pipeline.maths.precision import full_precision

F64 = npt.NDArray[np.float64]
ALPHA_MIN = 0.02
KAPPA_RANGE = (2.1, 89.0)  # where the fit of best_fit_alpha was made


@full_precision
def gauge_alpha(inv_kappa: Tensor) -> Tensor:
    """GGX width of a lobe of 1 / kappa, sqrt(1 / (2 kappa)) for narrow ones, in [ALPHA_MIN, 1). Any shape."""
    s = inv_kappa.clamp(min=1e-8)
    return ALPHA_MIN + (1 - ALPHA_MIN) * torch.sqrt(s / (2 + s))


def best_fit_alpha(kappa: npt.NDArray[np.floating] | float) -> F64:
    """GGX alpha of a lobe seen at normal incidence, for kappa of any shape; kappa is clamped to KAPPA_RANGE.

        alpha = 0.5407 (kappa - 1.517)^-0.486

    A fit to GGX lobes sampled by their visible normals and attenuated at order 10; its error is at most 0.015 in the
    range (least squares under light whose bands have power like 1 / (2 l + 1); other weights change it by up to 0.03).
    Differs from the small-angle form alpha = 0.707 / sqrt(kappa), whose error is 0.2 at kappa = 2.
    """
    k = np.clip(np.asarray(kappa, np.float64), *KAPPA_RANGE)
    out: F64 = 0.5407 * (k - 1.517) ** -0.486
    return out
