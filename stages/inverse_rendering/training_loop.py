"""The training loop of every fit: steps, dropped steps, running figures and checkpoints.

A fit is deterministic for one seed on one machine: every random number comes from a generator seeded by (seed, step),
and a checkpoint has everything else, so an interrupted fit continues with the same result. A fit with a time limit
(settings.seconds) continues too, but its number of steps depends on the time.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch

from pipeline.artifacts import RefinedCamera
from pipeline.errors import Cancelled, StageError
from pipeline.fields.face import FaceModel
from pipeline.registration.head_regions import Near
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.guard import Guard, cause_of, gradients_are_finite
from stages.inverse_rendering.model_selection import Choices
from stages.inverse_rendering.objective import Terms
from stages.inverse_rendering.ray_sampling import U8, Batch, PhotoView, PixelTable

OUTSIDE_SHARE = 0.25
CHECKPOINT_SHARE = 0.02  # largest share of the time for writing checkpoints
SMOOTHING = 0.98  # of the running loss and error
NOTED = 10  # number of running PSNR values that are stored during a fit


@dataclass(frozen=True, slots=True)
class Hooks:
    """Callbacks of the fit: progress, cancellation, the checkpoint's file, and a picture of the model as it is now, if
    it is time for one: returns the seconds that this took, and changes nothing of the fit."""

    progress: Callable[..., None]
    cancelled: Callable[[], bool]
    checkpoint: Path | None = None
    preview: Callable[[FaceModel], float] = lambda model: 0.0


@dataclass(slots=True)
class TrainingLoop(ABC):
    """The state of a running fit. A subclass has its schedule, its loss and its updates."""

    counted: ClassVar[tuple[str, ...]] = (
        "step",
        "loss",
        "error",
        "allowance",
        "spent",
    )  # plain numbers of a checkpoint

    views: list[PhotoView]
    settings: Config
    device: str
    model: FaceModel
    step: int = 0
    loss: float = float("nan")
    error: float = float("nan")
    allowance: float = 0.0  # seconds to train, by the clock; 0: settings.steps decide
    spent: float = 0.0
    table: PixelTable | None = None
    choices: Choices | None = None
    history: list[float] = field(default_factory=list)  # running PSNR after each tenth of the fit
    optimiser: torch.optim.Optimizer = field(init=False)
    guard: Guard = field(init=False)

    def __post_init__(self) -> None:
        self.optimiser = self.make_optimiser()
        self.guard = Guard(self.settings.max_dropped)

    # ---------------------------------------------------------------- what a fit has of its own
    @abstractmethod
    def make_optimiser(self) -> torch.optim.Optimizer:
        """The optimiser of the parameters."""

    @abstractmethod
    def enter_level(self) -> None:
        """Read the photos into the table, if the schedule requires it."""

    @abstractmethod
    def prepare(self) -> float:
        """Set up the next step by the schedule; returns the rate for `move`."""

    @abstractmethod
    def compute_terms(self, batch: Batch, generator: torch.Generator) -> Terms:
        """The parts of the loss."""

    @abstractmethod
    def move(self, rate: float) -> None:
        """Update the parameters. rate: that of `prepare`."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the model after the last step."""

    @abstractmethod
    def parts(self) -> dict[str, Any]:
        """Model and optimisers, for a checkpoint."""

    @abstractmethod
    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of `parts`."""

    def tend(self) -> None:  # noqa: B027  (most fits need nothing here)
        """Work after a step that is not part of its update."""

    def refined_cameras(self, widths: Mapping[int, int]) -> tuple[RefinedCamera, ...]:
        """The cameras that the fit moved. widths: of the whole photos in pixels, by the views' index."""
        return ()

    def pose_facts(self) -> dict[str, str | float | bool]:
        """For the report: how the fit moved the cameras."""
        return {"refined": False, "why": "the method has no refinement"}

    def know_labels(self, labels: Sequence[U8 | None], names: Sequence[str]) -> None:  # noqa: B027
        """Take note of the photos' labels. labels: (H, W) codes of each view, or None; names: of the codes."""

    def know_head(self, near: Near, plain: Near | None) -> None:  # noqa: B027
        """Take note of the placed head, and of its plain skin where the photos are an arc before it."""

    def photo_facts(self) -> dict[str, str | float | bool]:
        """For the report: how the photos were weighed."""
        return {"weighed": False, "why": "the method has no weights"}

    def photo_weights(self) -> list[tuple[float, float]]:
        """Mean weight and share of low weights of each photo; empty if all count alike."""
        return []

    def surface_facts(self) -> dict[str, str | float | bool]:
        """For the report: what the fit did to the surface beside its steps."""
        return {}

    def second_facts(self) -> dict[str, str | float | bool]:
        """For the report: where the light of a second capture comes from; empty without one."""
        return {}

    def trial_facts(self) -> dict[str, str | float | bool]:
        """For the report: decisions that were tried, if any may be."""
        return {}

    def geometry_is_finite(self) -> bool:
        """Whether the gradients outside of the optimiser are finite."""
        return True

    def forget(self) -> None:  # noqa: B027
        """Drop the gradients outside of the optimiser."""

    # ---------------------------------------------------------------- figures
    @property
    def psnr(self) -> float:
        """Running PSNR in dB over fully covered subject pixels of the fitted views."""
        return -10 * math.log10(max(self.error, 1e-10)) if math.isfinite(self.error) else float("nan")

    @property
    def pixels(self) -> PixelTable:
        """The photos' pixels at the current level."""
        self.enter_level()
        assert self.table is not None
        return self.table

    def share(self) -> float:
        """Finished share of the fit, in [0, 1]: of the time limit, or of the steps."""
        done = self.spent / self.allowance if self.allowance else self.step / self.settings.steps
        return min(done, 1.0)

    def total(self) -> int:
        """Steps of the whole fit; with a time limit, an estimate from the speed so far."""
        if not self.allowance:
            return self.settings.steps
        return max(round(self.step / max(self.share(), 1e-6)), self.step + (self.share() < 1))

    # ---------------------------------------------------------------- one step
    def advance(self) -> None:
        """One step, with its time."""
        begun = time.monotonic()
        self._advance()
        self.spent += time.monotonic() - begun
        while len(self.history) < int(NOTED * self.share()):
            self.history.append(self.psnr)

    def _advance(self) -> None:
        """Draw a batch, evaluate the loss, update the parameters."""
        table = self.pixels
        rate = self.prepare()
        seed = (self.settings.seed * 1_000_003 + self.step) & 0x7FFFFFFF
        batch = table.draw(self.settings.batch, OUTSIDE_SHARE, seed)
        self.optimiser.zero_grad(set_to_none=True)
        found = self._terms(batch, seed)
        loss, error = found.total, found.error
        if loss.requires_grad:  # false if the surface is frozen and no ray hits it
            loss.backward()
        if not self._is_finite(loss):
            self._drop(batch, seed)
            return
        self.move(rate)
        self.step += 1
        self.tend()
        self._note(float(loss.detach()), error)

    def _terms(self, batch: Batch, seed: int) -> Terms:
        generator = torch.Generator().manual_seed(seed + 1)
        return self.compute_terms(batch, generator)

    def _is_finite(self, loss: torch.Tensor) -> bool:
        finite = math.isfinite(float(loss.detach())) and self.geometry_is_finite()
        return finite and gradients_are_finite(self.optimiser)

    def _drop(self, batch: Batch, seed: int) -> None:
        """Skip this step without an update, and record the cause."""
        parameters: list[tuple[str, torch.Tensor]] = [
            (n, p) for n, p in self.model.named_parameters() if n != "geometry.values"
        ]
        cause = cause_of(self._terms(batch, seed), batch, [v.index for v in self.views], parameters)
        self.optimiser.zero_grad(set_to_none=True)
        self.forget()
        self.step += 1
        self.guard.drop(self.step, cause)

    def _note(self, loss: float, error: float) -> None:
        self.loss = loss if not math.isfinite(self.loss) else SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        if math.isfinite(error):
            known = math.isfinite(self.error)
            self.error = SMOOTHING * self.error + (1 - SMOOTHING) * error if known else error

    # ---------------------------------------------------------------- checkpoints
    def save(self, path: Path) -> None:
        """Write the state of the fit; the old file is kept until the new one is complete."""
        state = {
            "settings": repr(self.settings),
            "dropped": self.guard.causes,
            "history": self.history,
            **{name: getattr(self, name) for name in self.counted},
            **self.parts(),
        }
        torch.save(state, path.with_suffix(".new"))
        path.with_suffix(".new").rename(path)

    def load(self, path: Path) -> bool:
        """Continue from a checkpoint. False if it can't be read, or has other settings."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception:  # an incomplete or foreign file: start again
            return False
        if state["settings"] != repr(self.settings):
            return False
        self.restore(state)
        for name in self.counted:
            setattr(self, name, state[name])
        self.guard.causes, self.history = list(state["dropped"]), list(state["history"])
        return True


def run_fit(trainer: TrainingLoop, hooks: Hooks) -> FaceModel:
    """Train to the last step. Raises Cancelled after writing a checkpoint."""
    if hooks.checkpoint is not None and hooks.checkpoint.is_file():
        trainer.load(hooks.checkpoint)
    saved = shown = time.monotonic()
    writing = 0.1  # seconds to write a checkpoint; measured later
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
            raise Cancelled("stopped by the user; the next run continues from the checkpoint")
        if now - shown > 0.5:
            hooks.progress(trainer.step, trainer.total(), "fitting", loss=trainer.loss, psnr=trainer.psnr)
            trainer.spent += hooks.preview(trainer.model)  # counts for a time limit, and for nothing else
            shown = now
        if hooks.checkpoint is not None and now - saved > writing / CHECKPOINT_SHARE:
            trainer.save(hooks.checkpoint)
            saved = time.monotonic()
            writing = saved - now
    trainer.finish()
    return trainer.model
