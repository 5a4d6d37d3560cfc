"""Outgoing radiance of NeuFace: a diffuse and a specular closed form under SH light.

Symbols: a (N, 3) albedo in [0, 1]; n, wo (N, 3) unit, wo leaves the surface; w_r mirror direction of wo about n;
rho (N,) specular intensity in [0, 1]; cb (N,) = c(x) . B(wo, n) >= 0; s (N,) = 1 / kappa; c_lm ((L+1)^2, 3) light.
All radiance is linear Rec.709.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pipeline.maths import sh
from pipeline.maths.precision import full_precision
from pipeline.maths.vmf import ATTENUATIONS


@full_precision
def reflect(wo: Tensor, n: Tensor) -> Tensor:
    """Mirror direction w_r = 2 (n . wo) n - wo, (N, 3). Unit if both are."""
    return 2 * (n * wo).sum(-1, keepdim=True) * n - wo


@full_precision
def diffuse(albedo: Tensor, n: Tensor, light: Tensor) -> Tensor:
    """L_d = a / pi * max(E(n), 0), (N, 3). [NeuFace eq. 16]; the clamp is the supplement's (section B)."""
    return lambertian(albedo, sh.irradiance(light, n))


@full_precision
def lambertian(albedo: Tensor, irradiance: Tensor) -> Tensor:
    """a / pi * max(E, 0): (N, 3), (N, 3) -> (N, 3). The a / pi of [NeuFace eq. 3] times the
    integral of [NeuFace eq. 13]."""
    return albedo / math.pi * irradiance.clamp(min=0)


@full_precision
def light_integral(w_r: Tensor, inv_kappa: Tensor, light: Tensor, attenuation: str = "exponential") -> Tensor:
    """max(sum_l A_l(s) sum_m c_lm Y_lm(w_r), 0), (N, 3). [NeuFace eq. 11], [NeuFace eq. 28];
    clamp: supplement, section B."""
    bands = sh.band_radiance(light, w_r)
    a = ATTENUATIONS[attenuation](inv_kappa, bands.shape[1] - 1)
    return torch.einsum("nl,nlc->nc", a, bands).clamp(min=0)


@full_precision
def specular(rho: Tensor, cb: Tensor, incident: Tensor) -> Tensor:
    """L_s = rho (c . B) L(w_r), (N, 3). [NeuFace eq. 12], `incident` from `light_integral`. The integrals
    of material and light are separated: [NeuFace eq. 5]."""
    return (rho * cb)[:, None] * incident
