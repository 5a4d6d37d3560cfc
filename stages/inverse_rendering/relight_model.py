"""Another light for a fitted model: albedo and reflectance are learned anew so that the photos stay as they are.

    a' = a E / E',   rho' = rho R / R'

at points of the surface, with E the irradiance including shadows and interreflections, R the light reflected along the
normal [NeuFace eq. 11], mean of the colours; primes: under the new light. Diffuse radiance is kept exactly, the lobe's
where one looks straight at the surface. Left to the fit itself, the albedo would need hundreds of steps to follow, and
the surface would move meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel

STEPS, BATCH = 200, 8192
TABLE_RATE, NET_RATE = 1e-2, 3e-3
ALBEDO, RHO = (1e-3, 0.98), (1e-4, 0.98)  # limits of what the network's outputs can be
MOST = 4.0  # largest change of rho, where there was hardly any light to reflect
SEED = 5_039


@dataclass(frozen=True, slots=True)
class Lit:
    """Light on surface points: irradiance (N, 3) with shadows, reflected (N,)."""

    irradiance: Tensor
    reflected: Tensor


def lit(model: FaceModel, spatial: SpatialField, x: Tensor, n: Tensor) -> Lit:
    """The model's light at points x with unit normals n (N, 3)."""
    with torch.no_grad():
        irradiance = model.light.irradiance(n)
        if model.shadowing is not None:
            irradiance = irradiance * model.shadowing(x)
        reflected = model.light.reflected(n, spatial(x)[3], model.spec.attenuation).mean(-1)
    return Lit(irradiance.clamp(min=1e-9), reflected.clamp(min=1e-9))


def change_light(model: FaceModel, spatial: SpatialField, x: Tensor, n: Tensor, change: Callable[[], None]) -> float:
    """Change the light by `change`, solve the shadows, and learn the reflectance at points x with unit normals n (N, 3)
    anew; returns the RMS error of the learned albedo. The parameters of `spatial` have no gradients afterwards."""
    before = lit(model, spatial, x, n)
    change()
    model.solve_shadows()
    after = lit(model, spatial, x, n)
    with torch.no_grad():
        wanted: Tensor = spatial.net(spatial.encoding(x))
        albedo = torch.sigmoid(wanted[:, :3]) * before.irradiance / after.irradiance
        ratio = (before.reflected / after.reflected).clamp(1 / MOST, MOST)
        albedo, rho = albedo.clamp(*ALBEDO), (torch.sigmoid(wanted[:, 3]) * ratio).clamp(*RHO)
        wanted = torch.cat([torch.logit(albedo), torch.logit(rho)[:, None], wanted[:, 4:]], 1)
    _learn(spatial, x, wanted)
    with torch.no_grad():
        left = torch.sigmoid(spatial.net(spatial.encoding(x))[:, :3]) - albedo
    return float(left.square().mean().sqrt())


def _learn(spatial: SpatialField, x: Tensor, wanted: Tensor) -> None:
    """Fit the outputs of the last layer at x (N, 3) to `wanted` (N, 5 + k)."""
    generator = torch.Generator().manual_seed(SEED)
    groups = [
        {"params": [spatial.encoding.table], "lr": TABLE_RATE},
        {"params": list(spatial.net.parameters()), "lr": NET_RATE},
    ]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)
    for step in range(STEPS):
        for group in optimiser.param_groups:
            group["lr"] *= 1 if step < STEPS // 2 else 0.97
        i = torch.randint(len(x), (BATCH,), generator=generator).to(x.device)
        optimiser.zero_grad(set_to_none=True)
        loss = functional.mse_loss(spatial.net(spatial.encoding(x[i])), wanted[i])
        loss.backward()
        optimiser.step()
    spatial.zero_grad(set_to_none=True)
