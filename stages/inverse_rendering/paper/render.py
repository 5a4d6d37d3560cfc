"""The paper's rendering: every sample is shaded, then summed. [NeuFace section 4.4]

Symbols: Omega the prior's sphere; t_0 the surface by aggressive sphere tracing; hit rays have S samples in t_0 +-
SHELL of Omega's radius, other rays S sparse samples across Omega; w_i weights of [NeuFace eq. 18].

Differs: the last sample of a hit ray represents the solid behind it, up to where the ray leaves Omega, as in VolSDF:
with a shell of 1 mm and beta near 1 mm the samples alone would be half transparent. Other rays end at Omega: an
infinite last interval, as in the authors' code, gives empty rays a colour. Samples are stratified, not on a fixed
lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipeline.fields.face import FaceModel
from pipeline.fields.paper.displaced import HEAD, DisplacedSdf
from pipeline.maths.density import laplace_density, ray_weights
from pipeline.maths.sdf import unit
from pipeline.maths.tracing import sphere_interval
from stages.inverse_rendering.ray_sampling import Rays

SHELL = 5e-4 / HEAD  # of Omega's radius: samples lie in t_0 +- 0.5 mm of a head
NEGLIGIBLE = 1e-6  # samples with a smaller weight are not shaded: eight-bit colours have steps of 4e-3


@dataclass(frozen=True, slots=True)
class Rendered:
    """Colour and L_s (N, 3), opacity (N,), and for the losses the raw gradients (M, 3) and displacements (M,) at all
    samples of the rays `kept` (K,), M = K S."""

    colour: Tensor
    specular: Tensor
    opacity: Tensor
    gradient: Tensor
    moved: Tensor
    kept: Tensor


def geometry_of(model: FaceModel) -> DisplacedSdf:
    """The geometry of a model of method paper."""
    assert isinstance(model.geometry, DisplacedSdf)
    return model.geometry


def render_samples(model: FaceModel, rays: Rays, samples: int, jitter: Tensor | None) -> Rendered:
    """[NeuFace eq. 18] for N rays; `jitter` (N, samples) in [0, 1), default the centre of each interval."""
    geometry = geometry_of(model)
    centre, radius = geometry.known.sphere()
    near, far = sphere_interval(rays.o, rays.d, centre, radius)
    t0, hit, _ = geometry.trace(rays.o, rays.d, near, far)
    kept = torch.nonzero(far > near).squeeze(-1)
    o, d, t0, hit, near, far = (x[kept] for x in (rays.o, rays.d, t0, hit, near, far))
    shell = SHELL * radius
    first = torch.where(hit, t0 - shell, near)
    step = torch.where(hit, torch.full_like(t0, 2 * shell), far - near) / samples
    u = torch.arange(samples, device=o.device) + (0.5 if jitter is None else jitter[kept])
    x = o[:, None] + (first[:, None] + step[:, None] * u)[..., None] * d[:, None]
    flat = x.reshape(-1, 3)
    s, g, moved = geometry.with_displacement(flat)
    delta = step[:, None].repeat(1, samples)
    delta[:, -1] += torch.where(hit, (far - t0 - shell).clamp(min=0), torch.zeros_like(far))
    w, tau = ray_weights(laplace_density(s.reshape(delta.shape), geometry.beta()), delta)
    colour, specular = _shaded(model, flat, unit(g), -d.repeat_interleave(samples, 0), w.reshape(-1), samples)
    n = len(rays.d)
    out = [torch.zeros(n, 3, device=o.device).index_copy(0, kept, v) for v in (colour, specular)]
    opacity = torch.zeros(n, device=o.device).index_copy(0, kept, -torch.expm1(-tau))
    return Rendered(out[0], out[1], opacity, g, moved, kept)


def _shaded(model: FaceModel, x: Tensor, n: Tensor, wo: Tensor, w: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    """Weighted sums of radiance and of its specular part over each ray's samples: (K, 3) each."""
    pick = torch.nonzero(w.detach() > NEGLIGIBLE).squeeze(-1)
    shaded = model.shade(x[pick], n[pick], wo[pick])
    share = w[pick, None]
    empty = torch.zeros(len(w), 3, device=w.device)
    return (
        empty.index_copy(0, pick, share * shaded.total).reshape(-1, samples, 3).sum(1),
        empty.index_copy(0, pick, share * shaded.specular).reshape(-1, samples, 3).sum(1),
    )


def render_all(model: FaceModel, rays: Rays, samples: int, chunk: int = 4096) -> tuple[Tensor, Tensor]:
    """Premultiplied linear colour (N, 3) and opacity (N,) of any number of rays, without gradients."""
    colours, opacities = [], []
    with torch.no_grad():
        for i in range(0, len(rays.d), chunk):
            part = render_samples(model, Rays(rays.o[i : i + chunk], rays.d[i : i + chunk]), samples, None)
            colours.append(part.colour)
            opacities.append(part.opacity)
    return torch.cat(colours), torch.cat(opacities)
