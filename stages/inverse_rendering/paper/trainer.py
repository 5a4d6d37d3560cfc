"""The paper's fit: its networks, sampling, losses and schedule. [NeuFace section B]

Differs: sums over pixels are means over the batch, so that the weights do not depend on its size. Partly covered pixels
are left out, and the background is black: the masks replace the paper's ground-truth model. The displacement's term
[NeuFace eq. 24] has D in units of Omega's radius, so that its weight does not depend on the size of the subject.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from pipeline.colour import srgb_from_linear
from pipeline.errors import StageError
from pipeline.fields.face import FaceModel
from pipeline.fields.paper import build
from pipeline.fields.paper.prior_imface import ImFacePrior
from pipeline.fields.paper.priors import HullPrior
from pipeline.fields.spec import FaceSpec
from pipeline.maths import losses
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.initialise import spec_for
from stages.inverse_rendering.model_selection import given_model
from stages.inverse_rendering.objective import Terms, calibrated_colours
from stages.inverse_rendering.paper.config import PaperConfig
from stages.inverse_rendering.paper.render import geometry_of, render_samples
from stages.inverse_rendering.ray_sampling import WHOLE, Batch, PhotoView, PixelTable
from stages.inverse_rendering.training_loop import TrainingLoop

HALVED_EVERY, HALVED_UNTIL = 0.125, 0.75  # shares of the run: every 375 of 3,000 epochs, until 75 %
EMPTY = 0.01  # alpha of background is below


def rate_factor(share: float) -> float:
    """Learning rate at a share of the run, relative to its start: 0.5 ^ (number of halvings). [NeuFace section B]"""
    return float(0.5 ** int(min(share, HALVED_UNTIL) / HALVED_EVERY + 1e-9))


def paper_terms(model: FaceModel, batch: Batch, settings: PaperConfig, generator: torch.Generator) -> Terms:
    """All parts of [NeuFace eq. 20] with the paper's samples."""
    jitter = torch.rand(len(batch.alpha), settings.samples, generator=generator).to(batch.alpha.device)
    got = render_samples(model, batch.rays, settings.samples, jitter)
    colour = got.colour
    if model.spec.calibrated:
        colour = calibrated_colours(model.calibration(), batch.view, colour)
    whole = batch.alpha > WHOLE
    target = torch.where(whole[:, None], batch.target, torch.zeros_like(batch.target))
    sure = torch.nonzero(whole | (batch.alpha < EMPTY)).squeeze(-1)
    out = Terms()
    n_rays = max(len(batch.alpha), 1)
    rgb = losses.rgb_l1(colour[sure], target[sure])
    out.add("rgb", settings.rgb * rgb.sum() / n_rays, rgb, sure)
    out.add("white", settings.white * losses.white_light(model.light()).sum())
    energy = losses.specular_energy(got.specular)
    everyone = torch.arange(len(energy), device=energy.device)
    out.add("specular_energy", settings.specular_energy * energy.sum() / n_rays, energy, everyone)
    z = geometry_of(model).known.embeddings()
    if z is not None:
        out.add("embedding", settings.embedding * losses.embedding(z[None]).sum())
    if len(got.kept):
        places = got.kept.repeat_interleave(settings.samples)
        steep = losses.eikonal(got.gradient, squared=False)
        out.add("eikonal", settings.eikonal * steep.mean(), steep, places)
        moved = losses.displacement(got.moved) / geometry_of(model).known.sphere()[1]
        out.add("displacement", settings.displacement * moved.mean(), moved, places)
    if whole.any():
        with torch.no_grad():
            out.error = float(((srgb_from_linear(colour[whole].clamp(0, 1)) - target[whole]) ** 2).mean())
    return out


@dataclass(slots=True)
class PaperTrainer(TrainingLoop):
    """The paper's fit; the loop, the guard and the ray sampling are those of every fit."""

    settings: PaperConfig

    def __post_init__(self) -> None:
        TrainingLoop.__post_init__(self)  # super() has no cell in a dataclass with slots
        self.choices = given_model(self.settings, calibrated=self.model.spec.calibrated)

    def make_optimiser(self) -> torch.optim.Optimizer:
        """Adam with its default betas."""
        return paper_optimiser(self.model, self.settings)

    def enter_level(self) -> None:
        """Read the photos once, at full size."""
        if self.table is None:
            self.table = PixelTable(self.views, self.settings.image_side, self.device)

    def prepare(self) -> float:
        """Set the scheduled rates; beta is learnt, and copied to the model for its readers."""
        factor = rate_factor(self.share())
        for group in self.optimiser.param_groups:
            group["lr"] = group["start"] * factor
        self.model.beta.copy_(geometry_of(self.model).beta().detach())
        return 0.0

    def compute_terms(self, batch: Batch, generator: torch.Generator) -> Terms:
        """The paper's terms."""
        return paper_terms(self.model, batch, self.settings, generator)

    def move(self, rate: float) -> None:
        """Update the parameters."""
        self.optimiser.step()

    def finish(self) -> None:
        """Copy the final beta to the model."""
        self.model.beta.copy_(geometry_of(self.model).beta().detach())

    def parts(self) -> dict[str, Any]:
        """Model and optimiser, for a checkpoint."""
        return {"model": self.model.state_dict(), "optimiser": self.optimiser.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of `parts`."""
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])


def paper_optimiser(model: FaceModel, settings: PaperConfig) -> torch.optim.Optimizer:
    """Adam; the prior's networks have a reduced rate, its codes and everything else the full rate."""
    prior = geometry_of(model).known
    codes = {id(p) for n, p in model.named_parameters() if n.startswith("geometry.prior.z_")}
    slow = [p for n, p in model.named_parameters() if n.startswith("geometry.prior.") and id(p) not in codes]
    slow_ids = {id(p) for p in slow}
    estimate = {id(p) for p in model.light.parameters()}
    rest = [p for p in model.parameters() if id(p) not in slow_ids | estimate]
    groups = [
        {"params": rest, "start": settings.lr_appearance},
        {"params": list(model.light.parameters()), "start": settings.lr_light},
    ]
    if slow and prior.share > 0:
        groups.append({"params": slow, "start": settings.lr_appearance * prior.share})
    return torch.optim.Adam(groups, lr=settings.lr_appearance)


def new_paper_trainer(
    views: list[PhotoView],
    start: Start,
    settings: PaperConfig,
    calibrated: bool,
    device: str,
) -> PaperTrainer:
    """A new trainer of method paper. Raises StageError if prior is imface and its checkpoint can't be read."""
    torch.manual_seed(settings.seed)
    spec = replace(
        spec_for(views, start, settings, calibrated, device), geometry="displaced", prior=stored_prior(settings)
    )
    prior = prior_for(spec, start, settings)
    model = FaceModel(spec, build.displaced(spec, prior))
    model.to(device)
    return PaperTrainer(views, settings, device, model)


def stored_prior(settings: PaperConfig) -> str:
    """Kind of the prior in the model's file. The hull is one whether the head template has cut it or not."""
    return settings.prior if settings.prior in ("sphere", "imface") else "hull"


def prior_for(spec: FaceSpec, start: Start, settings: PaperConfig) -> nn.Module:
    """The geometry prior of the settings."""
    if settings.prior == "sphere":
        return build.sphere_prior(spec)
    if stored_prior(settings) == "hull":
        return HullPrior(torch.from_numpy(start.values), torch.from_numpy(start.lo.astype(np.float32)), start.cell)
    if not settings.prior_file:
        raise StageError(
            "the prior ImFace needs its weights, which are licensed and not part of this project",
            where="--set inverse_rendering.prior",
            value="imface without inverse_rendering.prior_file",
            limit="the path of a published checkpoint",
            remedy="see docs/imface.md for how to get one, or set inverse_rendering.prior=hull",
        )
    from pipeline.fields.paper.imface_layout import load_imface_state

    state = load_imface_state(Path(settings.prior_file))
    return ImFacePrior(state, torch.tensor(spec.prior_centre), spec.prior_scale)
