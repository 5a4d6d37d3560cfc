"""The training loop of a fit whose decisions are trials (trials.py): it can go back to a state that it kept."""

from __future__ import annotations

import copy
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any

import torch

from pipeline.fields.face import FaceModel
from pipeline.fields.spec import FaceSpec
from stages.inverse_rendering.probe import F64, judged_pixels, psnr_by_view, withheld
from stages.inverse_rendering.ray_sampling import PixelTable
from stages.inverse_rendering.training_loop import TrainingLoop
from stages.inverse_rendering.trials import State, Trials

CLOCK = ("allowance", "spent")  # counted, but not changed by going back


@dataclass(slots=True)
class TrialLoop(TrainingLoop):
    """A running fit with trials. judged: pixels of the table that the trials are judged by, None once all are
    fitted."""

    trials: Trials = field(init=False)
    judged: torch.Tensor | None = None
    validation: tuple[int, ...] = field(init=False)  # views that are not fitted before the model selection

    @abstractmethod
    def own_parts(self) -> dict[str, Any]:
        """The parts of a checkpoint without the trials."""

    @abstractmethod
    def restore_own(self, state: dict[str, Any]) -> None:
        """Inverse of `own_parts`."""

    # ---------------------------------------------------------------- pixels
    def read_photos(self, side: int) -> None:
        """Read the photos at `side` pixels into the table, without the pixels that are withheld."""
        self.table = PixelTable(self.views, side, self.device)
        if self.trials.withholds:
            chosen = withheld(self.table, self.views)
            self.judged = judged_pixels(self.table, chosen, len(self.views))
            self.table.withhold(chosen)
        self._exclude_validation()

    def probe(self) -> F64:
        """(V,) PSNR of each view in its pixels that are not fitted."""
        table = self.pixels
        assert self.judged is not None
        return psnr_by_view(self.model, table, self.judged, len(self.views), self.settings.samples)

    def release(self) -> None:
        """Fit the withheld pixels too from now on."""
        self.judged = None
        if self.table is not None:
            self.table.withhold(None)
            self._exclude_validation()

    def _exclude_validation(self) -> None:
        assert self.table is not None
        self.table.exclude(() if self.choices else self.validation)

    # ---------------------------------------------------------------- states
    def kept(self) -> State:
        """A copy of the whole state of the fit, except for its time."""
        counted = {name: getattr(self, name) for name in self.counted if name not in CLOCK}
        spec = self.model.spec.stored()
        return copy.deepcopy({"spec": spec, "counted": counted, "history": self.history, "parts": self.own_parts()})

    def recall(self, state: State) -> None:
        """Continue from a state that was kept, whatever parts the model has lost or got since."""
        state = copy.deepcopy(state)  # its tensors become those of the fit
        spec = FaceSpec.from_stored(state["spec"])
        if spec != self.model.spec:
            with torch.random.fork_rng(devices=[]):  # the parameters are overwritten
                self.model = FaceModel(spec, self.model.geometry).to(self.device)
            self.optimiser = self.make_optimiser()
        self.choices, self.model.uniform_albedo = None, False
        self.restore_own(state["parts"])
        for name, value in state["counted"].items():
            setattr(self, name, value)
        self.history = state["history"]

    def parts(self) -> dict[str, Any]:
        """Model, choices, optimisers and trials, for a checkpoint."""
        return {**self.own_parts(), "trials": self.trials.stored()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of `parts`."""
        self.restore_own(state)
        self.trials.restore(state["trials"])

    # ---------------------------------------------------------------- steps
    def share(self) -> float:
        """As for every fit; steps that a trial does again take no part of a time limit's schedule."""
        if not self.allowance or not self.trials.on:
            return TrainingLoop.share(self)
        return min(self.trials.share(self.step, self.spent, self.allowance), 1.0)

    def trial_facts(self) -> dict[str, str | float | bool]:
        """For the report: the trials."""
        return self.trials.facts()

    def _advance(self) -> None:
        """One step, after the verdict on a trial whose steps are done."""
        before = self.trials.withholds
        self.trials.settle(self)
        if before and not self.trials.withholds:
            self.release()
        TrainingLoop._advance(self)
