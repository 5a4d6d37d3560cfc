"""The compound objective: the one place where terms are weighed and summed. [NeuFace eq. 20]"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.colour import srgb_from_linear
from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.fields.face import FaceModel
from pipeline.maths import density, losses
from pipeline.maths.sdf import unit
from stages.inverse_rendering.render import sample_shell, shade_shell, solid_behind
from stages.inverse_rendering.settings import FitSettings
from stages.inverse_rendering.views import WHOLE, Batch


def objective(
    model: FaceModel, batch: Batch, settings: FitSettings, generator: torch.Generator, smooth_scale: float
) -> tuple[Tensor, float]:
    """Loss of a batch, and its mean squared error over whole subject pixels as people see it (sRGB)."""
    device = batch.alpha.device
    jitter = torch.rand(len(batch.alpha), settings.samples, generator=generator).to(device)
    shell = sample_shell(model, batch.rays, settings.samples, jitter, batch.alpha > 0.5)
    alpha = batch.alpha[shell.kept]
    n_rays = len(batch.alpha)
    tau = shell.tau + solid_behind(model, shell, batch.rays)
    silhouette = density.opacity_cross_entropy(tau, alpha).clamp(max=20) * batch.share[shell.kept]
    loss = settings.mask * silhouette.sum() / n_rays
    loss = loss + settings.eikonal * losses.eikonal(shell.gradient).mean()
    pick = torch.nonzero(shell.hit & (alpha > WHOLE)).squeeze(-1)
    if not len(pick):
        return loss, float("nan")
    shaded = shade_shell(model, shell, batch.rays, pick)
    colour, target = shaded.total, batch.target[shell.kept[pick]]
    if model.spec.calibrated:
        colour = _calibrated(model.calibration(), batch.view[shell.kept[pick]], colour)
    loss = loss + settings.rgb * losses.rgb_l1(colour, target).sum() / n_rays
    loss = loss + settings.white * losses.white_light(model.light()).sum()
    loss = loss + settings.specular_energy * losses.specular_energy(shaded.specular).mean()
    loss = loss + settings.parsimony * losses.albedo_parsimony(shaded.albedo).mean()
    if model.spec.specular:
        gauge = losses.shininess_gauge(shaded.inv_kappa, TYPICAL_INV_KAPPA)
        loss = loss + settings.shininess * gauge.mean()
    loss = loss + settings.smooth * smooth_scale * _smoothness(model, shell.x[pick].detach(), generator)
    with torch.no_grad():
        error = float(((srgb_from_linear(colour.clamp(0, 1)) - target) ** 2).mean())
    return loss, error


def _calibrated(matrices: Tensor, view: Tensor, colour: Tensor) -> Tensor:
    """I_n = A_n I: (V, 3, 3), (N,), (N, 3) -> (N, 3). [NeuFace eq. 19]

    The matrices are picked by a product with 0 and 1: the gradient of an indexed pick adds up in an order that depends
    on timing, and a fit would no longer repeat bit by bit.
    """
    chosen = torch.nn.functional.one_hot(view, len(matrices)).to(colour) @ matrices.reshape(-1, 9)
    return torch.einsum("nij,nj->ni", chosen.reshape(-1, 3, 3), colour)


def _smoothness(model: FaceModel, x: Tensor, generator: torch.Generator) -> Tensor:
    """Mean normal change over a jitter of one cell."""
    step = torch.randn(x.shape, generator=generator).to(x) * model.geometry.cell
    _, g = model.geometry(torch.cat([x, x + step]))
    n, near = unit(g).chunk(2)
    return losses.normal_consistency(n, near).mean()
