"""Terms of the objective, unreduced; stages.inverse_rendering.objective weighs and sums them."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.colour import srgb_from_linear
from pipeline.maths.precision import full_precision

RGB_SCALE = 0.03  # sRGB; residual from which on the colour loss pulls as hard as an absolute value


@full_precision
def rgb_l1(predicted: Tensor, target_srgb: Tensor) -> Tensor:
    """|I - I_bar|, mean over channels: (N, 3) linear, (N, 3) encoded -> (N,). [NeuFace eq. 21]

    Differs: sRGB values are compared, as in the metrics and close to perception, while the model is linear; in linear
    values highlights would dominate the loss.
    """
    return (srgb_from_linear(predicted) - target_srgb).abs().mean(-1)


@full_precision
def rgb_residual(predicted: Tensor, target_srgb: Tensor, bound: Tensor) -> Tensor:
    """|I - I_bar| by channel, with clipped values as inequalities: (N, 3) linear, (N, 3) encoded, (N, 3) -> (N, 3).

        |r| where bound = 0,  max(-r, 0) where bound > 0,  max(r, 0) where bound < 0;  r = I - I_bar, sRGB-encoded

    A sensor's largest value only says that the radiance is at least this value (bound > 0), its smallest that it is at
    most this value (bound < 0). Not in the paper.
    """
    r = srgb_from_linear(predicted) - target_srgb
    allowed = ((bound > 0) & (r > 0)) | ((bound < 0) & (r < 0))
    return torch.where(allowed, torch.zeros_like(r), r.abs())


@full_precision
def rgb_cost(residual: Tensor) -> Tensor:
    """Mean over the channels of Huber's loss of residuals r >= 0, sRGB-encoded: (N, 3) -> (N,).

        r^2 / (2 RGB_SCALE)  where r < RGB_SCALE,  else r - RGB_SCALE / 2

    The absolute value pulls at a pixel that is wrong by its noise alone as hard as at any other, and moves the surface
    by that. Differs from [NeuFace eq. 21], which is `rgb_l1`. Source: Huber, Robust estimation of a location parameter
    (1964).
    """
    tail = residual - RGB_SCALE / 2
    return torch.where(residual < RGB_SCALE, residual**2 / (2 * RGB_SCALE), tail).mean(-1)


@full_precision
def above(value: Tensor, limit: float) -> Tensor:
    """max(v / limit - 1, 0): (N,) -> (N,). A penalty for values that are larger than physically possible. Not in the
    paper."""
    return (value / limit - 1).clamp(min=0)


@full_precision
def white_light(coefficients: Tensor) -> Tensor:
    """|L_i - mean over RGB of L_i|, on the SH coefficients: (K, 3) -> (K,). [NeuFace eq. 22]

    Differs: per coefficient instead of per ray; the light does not depend on the ray, and the basis is orthonormal.
    """
    return (coefficients - coefficients.mean(-1, keepdim=True)).abs().mean(-1)


@full_precision
def specular_energy(specular: Tensor) -> Tensor:
    """L_s, mean over channels: (N, 3) -> (N,). [NeuFace eq. 23]; L_s >= 0 by construction."""
    return specular.mean(-1)


@full_precision
def shininess_prior(inv_kappa: Tensor, typical: float) -> Tensor:
    """ln^2(s / s_0): (N,) -> (N,), s = 1 / kappa. Not in the paper.

    Differs: the photos determine only the product of the light's band l and exp(-l (l + 1) s / 2): rougher skin under a
    sharper light looks the same, and without a prior s goes to 0 everywhere. A weak prior on its mean, at the typical
    width of skin, leaves the differences between points to the photos.
    """
    return torch.log(inv_kappa.clamp(min=1e-6) / typical) ** 2


@full_precision
def albedo_sparsity(albedo: Tensor) -> Tensor:
    """|ln a - median of ln a|, mean over channels: (N, 3) in [0, 1] -> (N,). Not in the paper.

    Differs: the photos determine only the product a E(n), so that on a still head under still light the albedo can
    contain any shading. This prior prefers the most uniform albedo, so that the light explains what depends on the
    normal. It uses the median and no square, so that it hardly penalises lips, brows and beard.
    """
    log = torch.log(albedo.clamp(min=1e-3))
    return (log - log.detach().median(0).values).abs().mean(-1)


@full_precision
def eikonal(gradient: Tensor, squared: bool = True) -> Tensor:
    """| |grad SDF| - 1 | or its square: (N, 3) -> (N,). The second term of [NeuFace eq. 24].

    The norm is sqrt(|g|^2 + 1e-12): its derivative at 0 stays finite, and 1e-6 is far below any real gradient.
    """
    residual = torch.sqrt((gradient * gradient).sum(-1) + 1e-12) - 1
    return residual * residual if squared else residual.abs()


@full_precision
def displacement(d: Tensor) -> Tensor:
    """|D(x)|, elementwise: the third term of [NeuFace eq. 24]."""
    return d.abs()


@full_precision
def embedding(z: Tensor) -> Tensor:
    """|z|^2 of the prior's embedding: the first term of [NeuFace eq. 24]."""
    return (z * z).sum(-1)


@full_precision
def normal_consistency(n: Tensor, n_near: Tensor) -> Tensor:
    """1 - n . n' at a point and a jittered neighbour: (N, 3), (N, 3) -> (N,). Not in the paper: it replaces the
    smoothness that the paper's MLP has and a grid does not have."""
    return 1 - (n * n_near).sum(-1)
