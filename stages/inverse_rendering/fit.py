"""The fit itself: start, coarse to fine, checkpoints. Arrays in, a FaceModel out; needs torch, numpy, scipy and OpenCV.

A fit repeats bit by bit for one seed on one machine: every random draw comes from a generator seeded by (seed, step),
and a checkpoint holds everything else, so that an interrupted fit goes on as if nothing had happened. A fit by the
clock (settings.seconds) goes on as well, but takes as many steps as its time allows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from pipeline.errors import Cancelled, StageError
from pipeline.fields.appearance import SpatialField
from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf, grid_of
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.guard import Guard, cause_of, gradients_are_finite
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.model_selection import (
    SELECTION_AT,
    Choices,
    apply_light,
    prior_surface,
    restored,
    select_model,
    take_over,
    validation_views,
)
from stages.inverse_rendering.objective import Terms, terms
from stages.inverse_rendering.ray_sampling import Batch, PhotoView, PixelTable

OUTSIDE_SHARE = 0.25
LEVEL_STARTS = {1: (0.0,), 2: (0.0, 0.3), 3: (0.0, 0.12, 0.35), 4: (0.0, 0.1, 0.25, 0.5)}
BAND_EVERY = 250
UNIFORM_FROM = 0.3  # share of the fit after which only the light is found for a while
OPEN_FROM = 0.4  # share of the encoding's levels, coarse first, that are open at the start
OPEN_UNTIL = 0.5  # share of the fit after which all of them are
UNIFORM_LIGHT_ORDER = 3  # diffuse skin tells hardly more of a light
UNIFORM_LIGHT_RATE = 10.0  # times the light's rate
KNOWN_LIGHT_RATE = 0.1  # times the light's rate once it is known from the lobe
SETTLING = 0.03  # share of the fit after it in which the surface rests
SHADOWS_AT = (0.3, 0.5, 0.7)  # shares of the fit at which shadows are solved anew
CHECKPOINT_SHARE = 0.02  # of the time since the last checkpoint that writing one may take
COUNTED = ("step", "loss", "error", "shadows_solved", "allowance", "spent")  # plain numbers of a checkpoint
SMOOTHING = 0.98  # of the running loss and error that are shown
NOTED = 10  # times in a fit that the running PSNR is kept


@dataclass(frozen=True, slots=True)
class Hooks:
    """How the fit talks to whoever runs it."""

    progress: Callable[..., None]
    cancelled: Callable[[], bool]
    checkpoint: Path | None = None


@dataclass(slots=True)
class Trainer:
    """The state of a fit under way."""

    views: list[PhotoView]
    settings: Config
    device: str
    model: FaceModel
    prior: Start | None = None
    step: int = 0
    level: int = 0
    loss: float = float("nan")
    error: float = float("nan")
    shadows_solved: int = 0
    allowance: float = 0.0  # seconds to train, by the clock; 0: settings.steps decide
    spent: float = 0.0
    table: PixelTable | None = None
    choices: Choices | None = None
    history: list[float] = field(default_factory=list)  # running PSNR after each tenth of the fit
    validation: tuple[int, ...] = field(init=False)
    optimiser: torch.optim.Optimizer = field(init=False)
    guard: Guard = field(init=False)

    def __post_init__(self) -> None:
        self.optimiser = self.make_optimiser()
        self.guard = Guard(self.settings.max_dropped)
        self.validation = validation_views(len(self.views), self.settings)

    def make_optimiser(self) -> torch.optim.Optimizer:
        """Of everything that has not its own."""
        return make_optimiser(self.model, self.settings)

    @property
    def psnr(self) -> float:
        """Running PSNR over whole subject pixels of the fitted views."""
        return -10 * math.log10(max(self.error, 1e-10)) if math.isfinite(self.error) else float("nan")

    @property
    def grid(self) -> GridSdf:
        """The surface, which has an optimiser of its own."""
        return grid_of(self.model.geometry)

    @property
    def pixels(self) -> PixelTable:
        """The photos' pixels at the present level."""
        self.enter_level()
        assert self.table is not None
        return self.table

    # ---------------------------------------------------------------- schedule
    def share(self) -> float:
        """How far the fit is, in [0, 1]: by the clock, or in steps."""
        done = self.spent / self.allowance if self.allowance else self.step / self.settings.steps
        return min(done, 1.0)

    def total(self) -> int:
        """Steps of the whole fit; by the clock, as many as its pace so far promises."""
        if not self.allowance:
            return self.settings.steps
        return max(round(self.step / max(self.share(), 1e-6)), self.step + (self.share() < 1))

    def enter_level(self) -> None:
        """Refine the grid and take larger photos when their time has come."""
        starts = LEVEL_STARTS[self.settings.levels]
        due = sum(self.share() >= s for s in starts) - 1
        while self.level < due:
            self.grid.refine()
            self.level += 1
            self.table = None
        if self.table is None:
            side = self.settings.image_side
            side = max(side // 2 ** (len(starts) - 1 - self.level), min(side, 256))
            self.table = PixelTable(self.views, side, self.device)
            self.table.wait(() if self.choices else self.validation)
        if self.geometry_frozen:
            self.grid.values.requires_grad_(False)

    @property
    def geometry_frozen(self) -> bool:
        """Whether the surface stays the prior that it began as."""
        return self.settings.refine_geometry == "off" or (self.choices is not None and not self.choices.refine_geometry)

    def select_model(self) -> None:
        """Find out what the scene requires, and leave out the rest."""
        assert self.table is not None
        choices, estimate = select_model(self)
        self.take(choices)
        for parameter in apply_light(self.model, estimate) if estimate is not None else ():
            self.optimiser.state.pop(parameter, None)
        self.table.wait(())

    def take(self, choices: Choices) -> None:
        """Go on with the model that was chosen. What stays of a parameter keeps its momentum."""
        swaps, known = take_over(self.model, choices), self.optimiser.state
        self.choices = choices
        if swaps:
            self.optimiser = self.make_optimiser()
        for group in self.optimiser.param_groups if swaps else ():
            for new in group["params"]:
                old, rows = swaps.get(new, (new, slice(None)))
                if old in known:
                    self.optimiser.state[new] = {
                        k: v[rows].clone() if v.shape == old.shape else v for k, v in known[old].items()
                    }
        if self.geometry_frozen and self.prior is not None:
            self.grid.restore(prior_surface(self).values.detach())
            self.grid.values.requires_grad_(False)

    def set_rates(self) -> float:
        """Learning rates, beta and open encoding levels of this step; returns the SDF's rate in asset units.

        Differs: beta follows a geometric schedule down to `beta_end` cells of the finest grid and is not learnt: a
        learnt one stays near a millimetre and blurs silhouettes (docs/benchmarks.md).

        Between UNIFORM_FROM and `uniform_albedo_until` a light that is known from the lobe (light_estimate.py) is
        frozen together with the surface, while the skin takes up what it leaves; then it moves slowly. Where the lobe
        does not tell it, everything is frozen but the light, and the albedo is uniform: the light, which began as the
        same from everywhere, explains what it can of the shading that the albedo had taken up until then. Any earlier,
        and a surface that is still the hull bends to what is wrong.
        """
        s, p = self.settings, self.share()
        decay: float = 0.1 ** max((p - 0.3) / 0.7, 0.0)
        warm = min((self.step + 1) / 50, 1.0)
        interlude = UNIFORM_FROM <= p < s.uniform_albedo_until
        light_known = self.choices is not None and self.choices.light_known
        self.model.uniform_albedo = interlude and not light_known
        for group in self.optimiser.param_groups:
            light = group["params"][0] is next(self.model.light.parameters())
            group["lr"] = group["start"] * decay * warm
            if interlude and not light_known:
                group["lr"] *= UNIFORM_LIGHT_RATE if light else 0.0
            elif light_known and light:
                group["lr"] *= 0.0 if interlude else KNOWN_LIGHT_RATE
        finest = self.model.geometry.cell / 2 ** (len(LEVEL_STARTS[s.levels]) - 1 - self.level)
        start, end = 0.5 * finest * 2 ** (len(LEVEL_STARTS[s.levels]) - 1), s.beta_end * finest
        self.model.beta.fill_(start * (end / start) ** min(p / 0.8, 1.0))
        opened = OPEN_FROM + (1 - OPEN_FROM) * min(p / OPEN_UNTIL, 1.0)
        _hashed(self.model).encoding.open_levels(opened)
        # skin takes up what the new light leaves, not the surface
        still = UNIFORM_FROM <= p < s.uniform_albedo_until + SETTLING
        return 0.0 if still or self.geometry_frozen else s.lr_sdf * self.model.geometry.cell * decay * warm

    # ---------------------------------------------------------------- one step
    def advance(self) -> None:
        """One step, and the time that it took."""
        begun = time.monotonic()
        self._advance()
        self.spent += time.monotonic() - begun
        while len(self.history) < int(NOTED * self.share()):
            self.history.append(self.psnr)

    def _advance(self) -> None:
        """Draw, evaluate, move."""
        self.enter_level()
        assert self.table is not None
        if self.choices is None and self.share() >= SELECTION_AT:
            self.select_model()
        rate = self.set_rates()
        due = sum(self.share() >= s for s in SHADOWS_AT)
        if self.shadows_solved < due:
            self.model.solve_shadows()
            self.shadows_solved = due
        seed = (self.settings.seed * 1_000_003 + self.step) & 0x7FFFFFFF
        batch = self.table.draw(self.settings.batch, OUTSIDE_SHARE, seed)
        self.optimiser.zero_grad(set_to_none=True)
        found = self._terms(batch, seed)
        loss, error = found.total, found.error
        if loss.requires_grad:  # not so where the surface rests and no ray meets it
            loss.backward()
        if not self._is_finite(loss):
            self._drop(batch, seed)
            return
        if self.model.uniform_albedo:
            self.model.light.uniform_gradient(UNIFORM_LIGHT_ORDER)
        self.move(rate)
        self.step += 1
        if self.step % BAND_EVERY == 0:
            self.tend()
        self._note(float(loss.detach()), error)

    def move(self, rate: float) -> None:
        """Take the step."""
        self.optimiser.step()
        self.grid.step(rate)

    def tend(self) -> None:
        """What is due every BAND_EVERY steps."""
        self.grid.find_band()

    def finish(self) -> None:
        """What is due after the last step."""
        self.grid.redistance()

    def _terms(self, batch: Batch, seed: int) -> Terms:
        generator = torch.Generator().manual_seed(seed + 1)
        return self.compute_terms(batch, generator)

    def compute_terms(self, batch: Batch, generator: torch.Generator) -> Terms:
        """The parts of the loss. With bfloat16 the networks' products are short; the maths holds its own precision."""
        kind, short = torch.device(self.device).type, self.settings.precision == "bfloat16"
        with torch.autocast(kind, torch.bfloat16, enabled=short):
            return terms(self.model, batch, self.weights(), generator, 1.0 - 0.8 * self.share())

    def weights(self) -> Config:
        """The settings; once the light is known, skin need not be even: that would drive paint into the lobe."""
        light_known = self.choices is not None and self.choices.light_known
        return self.settings.changed(albedo_sparsity=0.0) if light_known else self.settings

    def geometry_is_finite(self) -> bool:
        """Whether the gradients that the optimiser does not know of are finite."""
        return self.grid.gradient_is_finite()

    def _is_finite(self, loss: torch.Tensor) -> bool:
        finite = math.isfinite(float(loss.detach())) and self.geometry_is_finite()
        return finite and gradients_are_finite(self.optimiser)

    def _drop(self, batch: Batch, seed: int) -> None:
        """Leave everything as it was before this step, say why, and go on with the next one."""
        parameters: list[tuple[str, torch.Tensor]] = [
            (n, p) for n, p in self.model.named_parameters() if n != "geometry.values"
        ]
        cause = cause_of(self._terms(batch, seed), batch, [v.index for v in self.views], parameters)
        self.optimiser.zero_grad(set_to_none=True)
        self.forget()
        self.step += 1
        self.guard.drop(self.step, cause)

    def forget(self) -> None:
        """Drop gradients that the optimiser does not know of."""
        self.grid.drop_gradient()

    def _note(self, loss: float, error: float) -> None:
        self.loss = loss if not math.isfinite(self.loss) else SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        if math.isfinite(error):
            known = math.isfinite(self.error)
            self.error = SMOOTHING * self.error + (1 - SMOOTHING) * error if known else error

    # ---------------------------------------------------------------- checkpoints
    def save(self, path: Path) -> None:
        """Write everything that the rest of the fit depends on; the old file stays until the new one is whole."""
        state = {
            "settings": repr(self.settings),
            "dropped": self.guard.causes,
            "history": self.history,
            **{name: getattr(self, name) for name in COUNTED},
            **self.parts(),
        }
        torch.save(state, path.with_suffix(".new"))
        path.with_suffix(".new").rename(path)

    def load(self, path: Path) -> bool:
        """Go on from a checkpoint. False if there is none that can be read, or it is of other settings."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception:  # a torn or foreign file: begin anew
            return False
        if state["settings"] != repr(self.settings):
            return False
        self.restore(state)
        for name in COUNTED:
            setattr(self, name, state[name])
        self.guard.causes, self.history = list(state["dropped"]), list(state["history"])
        return True

    def parts(self) -> dict[str, Any]:
        """Model, choices and optimisers, as a checkpoint holds them."""
        g = self.grid
        return {
            "level": self.level,
            "choices": self.choices.plain() if self.choices else None,
            "cell": g.cell,
            "model": self.model.state_dict(),
            "band": g.optimiser_state(),
            "optimiser": self.optimiser.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of `parts`."""
        g = self.grid
        g.cell = float(state["cell"])
        self.level = state["level"]
        if state["choices"] is not None:
            self.take(restored(state["choices"]))
        g.restore(state["model"]["geometry.values"].to(self.device))
        self.model.load_state_dict(state["model"])
        g.load_optimiser_state(state["band"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.table = None


def make_optimiser(model: FaceModel, settings: Config) -> torch.optim.Optimizer:
    """Adam over everything but the SDF, which has its own in the band. The table has no momentum to spare: eps is
    small, because most of its entries see a gradient only now and then."""
    spatial = _hashed(model)
    groups = [
        {"params": [spatial.encoding.table], "start": settings.lr_appearance},
        {"params": [*spatial.net.parameters(), *model.basis.parameters()], "start": 0.3 * settings.lr_appearance},
        {"params": list(model.light.parameters()), "start": settings.lr_light},
        {"params": list(model.calibration.parameters()), "start": 0.1 * settings.lr_appearance},
    ]
    return torch.optim.Adam(groups, lr=1e-3, betas=(0.9, 0.99), eps=1e-15, fused=True)


def _hashed(model: FaceModel) -> SpatialField:
    """The Spatial MLP, whose table and levels are handled apart."""
    assert isinstance(model.spatial, SpatialField)
    return model.spatial


def run_fit(trainer: Trainer, hooks: Hooks) -> FaceModel:
    """Train to the last step, or raise Cancelled after writing a checkpoint."""
    if hooks.checkpoint is not None and hooks.checkpoint.is_file():
        trainer.load(hooks.checkpoint)
    saved = shown = time.monotonic()
    writing = 0.1  # seconds a checkpoint takes, until one was written
    while trainer.share() < 1.0:
        try:
            trainer.advance()
        except StageError:
            if hooks.checkpoint is not None:
                trainer.save(hooks.checkpoint)
            raise
        now = time.monotonic()
        if hooks.cancelled():
            if hooks.checkpoint is not None:
                trainer.save(hooks.checkpoint)
            raise Cancelled("stopped by the user; the fit goes on from its checkpoint next time")
        if now - shown > 0.5:
            hooks.progress(trainer.step, trainer.total(), "fitting", loss=trainer.loss, psnr=trainer.psnr)
            shown = now
        if hooks.checkpoint is not None and now - saved > writing / CHECKPOINT_SHARE:
            trainer.save(hooks.checkpoint)
            saved = time.monotonic()
            writing = saved - now
    trainer.finish()
    return trainer.model
