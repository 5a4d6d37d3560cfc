"""The loss: its terms are weighted and summed here. [NeuFace eq. 20]"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pipeline.colour import srgb_from_linear
from pipeline.fields.appearance import TYPICAL_INV_KAPPA
from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import grid_of
from pipeline.maths import density, losses, microfacet, sh
from pipeline.maths.sdf import unit
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.ray_sampling import WHOLE, Batch
from stages.inverse_rendering.render import sample_shell, shade_shell, solid_behind

HIDDEN_LIGHT, HIDDEN_DIRECTIONS, BEHIND = 1e-3, 400, 0.3  # weight; directions over the sphere; their least z


@dataclass(frozen=True, slots=True)
class Seen:
    """K rays of the colour term, detached: rays (K,) indices in the batch; residual (K,) mean absolute difference of
    the channels, sRGB, without any weight; x, n (K, 3) surface point and normal."""

    rays: Tensor
    residual: Tensor
    x: Tensor
    n: Tensor


@dataclass(slots=True)
class Terms:
    """The terms of the loss. scalars: weighted, by name, in the order of summation. values: detached values of single
    rays with their indices in the batch, for error messages. error: mean squared error (sRGB) over fully covered
    subject pixels, NaN if the batch has none. seen: the rays of the colour term, None if there is none."""

    scalars: dict[str, Tensor] = field(default_factory=dict)
    values: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    error: float = float("nan")
    seen: Seen | None = None

    def add(self, name: str, scalar: Tensor, values: Tensor | None = None, rays: Tensor | None = None) -> None:
        """Add a term of the loss."""
        self.scalars[name] = scalar
        if values is not None and rays is not None:
            self.values[name] = (values.detach(), rays)

    @property
    def total(self) -> Tensor:
        """The sum. [NeuFace eq. 20]"""
        parts = list(self.scalars.values())
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total


def terms(
    model: FaceModel,
    batch: Batch,
    settings: Config,
    generator: torch.Generator,
    smooth_scale: float,
    weights: Tensor | None = None,
) -> Terms:
    """All terms of [NeuFace eq. 20]. A batch without rays near the subject gives zeros. smooth_scale: factor of the
    smoothness term. weights: (N,) of the rays in the colour term, None: all count alike."""
    device = batch.alpha.device
    jitter = torch.rand(len(batch.alpha), settings.samples, generator=generator).to(device)
    shell = sample_shell(model, batch.rays, settings.samples, jitter, batch.alpha > 0.5)
    alpha = batch.alpha[shell.kept]
    n_rays = max(len(batch.alpha), 1)
    out = Terms()
    tau = shell.tau + solid_behind(model, shell, batch.rays)
    silhouette = density.opacity_cross_entropy(tau, alpha).clamp(max=20) * batch.share[shell.kept]
    out.add("mask", settings.mask * silhouette.sum() / n_rays, silhouette, shell.kept)
    if not len(shell.kept):
        return out
    steep = losses.eikonal(shell.gradient)
    out.add("eikonal", settings.eikonal * steep.mean(), steep, shell.kept.repeat_interleave(settings.samples))
    pick = torch.nonzero(shell.hit & (alpha > WHOLE)).squeeze(-1)
    if not len(pick):
        return out
    rays = shell.kept[pick]
    shaded = shade_shell(model, shell, batch.rays, pick)
    colour, target = shaded.total, batch.target[rays]
    if model.spec.colour_matrices:
        colour = calibrated_colours(model.calibration(), batch.view[rays], colour)
    residual = losses.rgb_residual(colour, target, batch.bound[rays])
    rgb = losses.rgb_cost(residual)
    counted = rgb if weights is None else rgb * weights[rays]
    out.add("rgb", settings.rgb * counted.sum() / n_rays, rgb, rays)
    x = shell.x[pick].detach()
    out.seen = Seen(rays, residual.detach().mean(-1), x, shell.n[pick].detach())
    out.add("white", settings.white * losses.white_light(model.light()).sum())
    if model.ambient is not None:
        out.add("hidden_light", HIDDEN_LIGHT * hidden_light(model.light(), model.spec.light_start))
    energy = losses.specular_energy(shaded.specular)
    out.add("specular_energy", settings.specular_energy * energy.mean(), energy, rays)
    uneven = losses.albedo_sparsity(shaded.albedo)
    out.add("albedo_sparsity", settings.albedo_sparsity * uneven.mean(), uneven, rays)
    if model.spec.specular:
        shininess = losses.shininess_prior(shaded.inv_kappa, TYPICAL_INV_KAPPA)
        out.add("shininess_prior", settings.shininess_prior * shininess.mean(), shininess, rays)
        if model.has_bases:
            high = losses.above(f0_of(shaded.along_normal, shaded.inv_kappa), settings.f0_limit)
            out.add("f0_excess", settings.f0_excess * high.mean(), high, rays)
    if grid_of(model.geometry).values.requires_grad:  # not for a frozen surface
        out.add("smooth", settings.smooth * smooth_scale * _smoothness(model, x, generator))
    with torch.no_grad():
        exact = batch.bound[rays] == 0
        square = (srgb_from_linear(colour.clamp(0, 1)) - target) ** 2
        out.error = float((square * exact).sum() / exact.sum().clamp(min=1))
    return out


def hidden_light(light: Tensor, usual: float) -> Tensor:
    """Mean square of the radiance of a light ((L + 1)^2, 3) in its frame over the directions behind the subject, over
    the square of a usual radiance: photos hardly show what comes from there, and exported shaders would show it as a
    bright rim."""
    d = torch.from_numpy(sh.spiral(HIDDEN_DIRECTIONS)).to(light)
    return (sh.radiance(light, d[d[:, 2] > BEHIND]) ** 2).mean() / max(usual, 1e-12) ** 2


def calibrated_colours(matrices: Tensor, view: Tensor, colour: Tensor) -> Tensor:
    """I_n = A_n I: (V, 3, 3), (N,), (N, 3) -> (N, 3). [NeuFace eq. 19]

    The matrices are selected by a product with one-hot vectors: the gradient of indexing is summed in an order that
    depends on timing, and a fit would not be deterministic.
    """
    chosen = torch.nn.functional.one_hot(view, len(matrices)).to(colour) @ matrices.reshape(-1, 9)
    return torch.einsum("nij,nj->ni", chosen.reshape(-1, 3, 3), colour)


def f0_of(along_normal: Tensor, inv_kappa: Tensor) -> Tensor:
    """F0 (N,) of the GGX lobe with this reflectance along the normal (N,) (pipeline.maths.microfacet.f0_from_lobe).

    The width 1 / kappa (N,) has no gradient: a lobe that reflects too much must become weaker, not narrower.
    """
    ratio = microfacet.f0_from_lobe(np.ones(len(inv_kappa)), inv_kappa.detach().float().cpu().numpy())
    return along_normal * torch.from_numpy(ratio).to(along_normal)


def _smoothness(model: FaceModel, x: Tensor, generator: torch.Generator) -> Tensor:
    """Mean change of the normal between points x (N, 3) and copies displaced by a random step of about one cell."""
    step = torch.randn(x.shape, generator=generator).to(x) * model.geometry.cell
    _, g = model.geometry(torch.cat([x, x + step]))
    n, near = unit(g).chunk(2)
    return losses.normal_consistency(n, near).mean()
