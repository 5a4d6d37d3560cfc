"""The fit: coarse-to-fine schedule, model selection and updates. It needs torch, numpy, scipy and OpenCV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from pipeline.artifacts import RefinedCamera
from pipeline.fields.geometry import GridSdf, grid_of
from pipeline.fields.parts import Part
from pipeline.maths.light_frame import WORLD
from pipeline.registration.head_regions import Near
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.depth_from_flow import FOLLOW_AT, follow_flow
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.model_selection import (
    SELECTION_AT,
    Choices,
    apply_light,
    facts_of,
    given_model,
    own_lights,
    prior_surface,
    restored,
    select_model,
    take_over,
    unselected,
    validation_views,
)
from stages.inverse_rendering.objective import Terms, terms
from stages.inverse_rendering.ray_sampling import U8, Batch
from stages.inverse_rendering.refine_poses import REFINE_AT, PoseHistory
from stages.inverse_rendering.robust import OBSERVE_FROM, WEIGH_AT, Robust
from stages.inverse_rendering.schedule import (
    LEVEL_STARTS,
    SETTLING,
    SHADOWS_AT,
    SKIN_AT,
    UNIFORM_LIGHT_ORDER,
    hashed,
    make_optimiser,
    set_rates,
)
from stages.inverse_rendering.second_capture import correct_lights, first_capture, light_from_first, of_first
from stages.inverse_rendering.skin_light import correct_light
from stages.inverse_rendering.training_loop import TrainingLoop
from stages.inverse_rendering.trial_loop import TrialLoop
from stages.inverse_rendering.trials import LENGTH, SELECTION, SHADOWS, SKIN, SMOOTHING, Trials
from stages.inverse_rendering.weakly_seen import FACE, RIPPLE, RIPPLES_AT, smooth_weakly_seen, smoothing_shares

BAND_EVERY = 250  # steps after which the narrow band is found again
SKIN_RAYS = 40_000  # surface points at which the reflectance is learned anew


@dataclass(slots=True)
class Trainer(TrialLoop):
    """The state of a running fit. prior: the surface with which refined geometry is compared. light_given: where the
    light comes from, if it is known before the fit: then it never changes."""

    counted: ClassVar[tuple[str, ...]] = (
        *TrainingLoop.counted,
        "shadows_solved",
        "skin_asked",
        "skin_tells",
        "refinements",
        "followed",
        "flowed",
        "smoothings",
        "smoothed",
    )

    prior: Start | None = None
    light_given: str = ""
    level: int = 0
    shadows_solved: int = 0
    refinements: int = 0  # of the camera poses
    followed: int = 0  # times that the surface was moved by the flow
    flowed: float = 0.0  # asset units, by which 95 % of it moved at most
    smoothings: int = 0  # of surface that the photos hardly determine
    smoothed: float = 0.0  # share of the surface that the last of them reached
    near_head: Near | None = None  # the placed head, where unlabelled skin may be
    plain_face: Near | None = None  # its cheeks, forehead and chin, where its photos are an arc before it
    skin_asked: bool = False
    skin_tells: bool = False  # the light's low bands are those that the skin tells
    known_of_second: dict[str, str | float | bool] = field(default_factory=dict)  # of the second capture's light
    poses: PoseHistory = field(init=False)
    robust: Robust = field(init=False)

    def __post_init__(self) -> None:
        TrainingLoop.__post_init__(self)  # super() has no cell in a dataclass with slots
        self.validation = validation_views(len(of_first(self.views)), self.settings)
        self.poses = PoseHistory.of(self.views)
        self.robust = Robust(self.views, self.settings.weigh_photos, self.settings.image_side)
        self.trials = Trials(self.settings.trials == "on")

    def make_optimiser(self) -> torch.optim.Optimizer:
        """The optimiser of all parameters except the SDF grid, which has its own."""
        return make_optimiser(self.model, self.settings)

    @property
    def grid(self) -> GridSdf:
        """The SDF grid, which has its own optimiser."""
        return grid_of(self.model.geometry)

    # ---------------------------------------------------------------- schedule
    def enter_level(self) -> None:
        """Refine the grid and use larger photos when the schedule requires it."""
        starts = LEVEL_STARTS[self.settings.levels]
        due = sum(self.share() >= s for s in starts) - 1
        while self.level < due:
            self.grid.refine()
            self.level += 1
            self.table = None
        if self.table is None:
            side = self.settings.image_side
            side = max(side // 2 ** (len(starts) - 1 - self.level), min(side, 256))
            self.read_photos(side)
        if self.geometry_frozen:
            self.grid.values.requires_grad_(False)

    @property
    def geometry_frozen(self) -> bool:
        """Whether the surface is frozen at the prior."""
        return self.settings.refine_geometry == "off" or (self.choices is not None and not self.choices.refine_geometry)

    @property
    def light_moves(self) -> bool:
        """Whether the light moves relative to the subject."""
        return self.model.spec.light_frame != WORLD

    @property
    def light_told(self) -> bool:
        """Whether the light's low bands are those that skin, or a second capture, tells."""
        return self.skin_tells or "albedos_differ" in self.known_of_second

    def select_model(self) -> None:
        """Select the model by cross-validation, and remove the other parts. Under a light that moves, a point's mean
        over the views is not its diffuse radiance, on which the comparison rests: everything is kept."""
        assert self.table is not None
        if self.light_moves:
            given = given_model(self.settings, calibrated=self.model.spec.calibrated)
            self.choices = replace(given, facts=facts_of(given, self.settings, "the light moves with the camera"))
            self.table.exclude(())
            return
        settled = self.settings.uniform_albedo_until + SETTLING + LENGTH
        wanted = self.trials.allows(self, SELECTION, settled, self.validation)
        first = first_capture(self)
        choices, estimate = select_model(first) if wanted else (unselected(first), None)
        self.take(choices)
        for parameter in apply_light(self.model, estimate) if estimate is not None else ():
            self.optimiser.state.pop(parameter, None)
        if self.model.second is not None and choices.light_known:
            self.known_of_second = light_from_first(self)
            self.restart(*own_lights(self.model))
        self.table.exclude(())

    def take(self, choices: Choices) -> None:
        """Continue with the selected model. The kept part of a parameter keeps its momentum."""
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

    def prepare(self) -> float:
        """Select the model, set the rates and solve the shadows when they are due; returns the SDF's rate in asset
        units."""
        if self.choices is None and self.share() >= SELECTION_AT:
            self.select_model()
        rate = self.set_rates()
        self.refine_poses()
        self.follow_flow()
        self.smooth()
        self.weigh_photos()
        due = sum(self.share() >= s for s in SHADOWS_AT)
        if self.shadows_solved < due:
            if self.model.shadowing is not None and self.trials.allows(self, SHADOWS):
                self.model.solve_shadows()
            self.shadows_solved = due
        still_light = not self.light_moves and not self.light_given
        if self.model.second is not None and self.choices is not None and self.share() >= SKIN_AT:
            if not self.skin_asked:
                self.ask_second()
            self.skin_asked = True
        asked = self.settings.skin_light and still_light and self.share() >= SKIN_AT
        if asked and self.choices is not None and not self.skin_asked:
            if self.trials.allows(self, SKIN):
                self.ask_skin(self.choices)
            self.skin_asked = True
        return rate

    def refine_poses(self) -> None:
        """Register the photos to the model when it is due, and move their cameras."""
        due = sum(self.share() >= s for s in REFINE_AT)
        if self.settings.refine_poses == "off" or self.choices is None or self.refinements >= due:
            return
        self.views = self.poses.refine(self.model, self.views, self.settings, self.device)
        self.pixels.place(self.views)
        self.refinements = due

    def follow_flow(self) -> None:
        """Move the surface to the depth that optical flow tells, when it is due."""
        due = sum(self.share() >= s for s in FOLLOW_AT)
        if self.settings.follow_flow != "on" or self.followed >= due or self.geometry_frozen or self.choices is None:
            return
        side, samples = self.settings.image_side, self.settings.samples
        moved = follow_flow(self.model, self.views, side, samples, self.device)
        self.flowed = max(self.flowed, moved)
        self.followed = due

    def smooth(self) -> None:
        """Smooth the surface where the photos hardly determine it, when it is due; at last its ripples alone."""
        shares, longest = smoothing_shares(self.settings.steps), self.settings.unseen_smoothing
        due = sum(self.share() >= s for s in (*shares, RIPPLES_AT))
        if longest <= 0 or self.smoothings >= due or self.geometry_frozen:
            return
        if due > len(shares):
            smooth_weakly_seen(self.grid, self.views, self.settings.image_side, longest, RIPPLE)
            if self.plain_face is not None:
                smooth_weakly_seen(self.grid, self.views, self.settings.image_side, longest, *FACE, self.plain_face)
        elif self.trials.allows(self, SMOOTHING):
            self.smoothed = smooth_weakly_seen(self.grid, self.views, self.settings.image_side, longest)
        self.smoothings = due

    def weigh_photos(self) -> None:
        """Weigh the photos and their parts by their residuals so far, when it is due."""
        due = sum(self.share() >= s for s in WEIGH_AT)
        if self.settings.weigh_photos and self.robust.due < due:
            self.robust.weigh()
            self.robust.due = due

    def know_labels(self, labels: Sequence[U8 | None], names: Sequence[str]) -> None:
        """Hair and eyes move between photos: their residuals may lie further from the others."""
        if self.settings.weigh_photos:
            self.robust.know_labels(labels, names)

    def know_head(self, near: Near, plain: Near | None) -> None:
        """Unlabelled skin near the placed head tells about the light as well; plain skin gets no ripples."""
        self.near_head, self.plain_face = near, plain

    def photo_facts(self) -> dict[str, str | float | bool]:
        """For the report: how the photos were weighed."""
        return self.robust.facts()

    def photo_weights(self) -> list[tuple[float, float]]:
        """Mean weight and share of low weights of each photo; empty if all count alike."""
        return self.robust.of_photos()

    def refined_cameras(self, widths: Mapping[int, int]) -> tuple[RefinedCamera, ...]:
        """The cameras that the fit moved. widths: of the whole photos in pixels, by the views' index."""
        return self.poses.cameras(self.views, widths)

    def pose_facts(self) -> dict[str, str | float | bool]:
        """For the report: how the fit moved the cameras."""
        return self.poses.facts(self.views, self.settings.refine_poses)

    def surface_facts(self) -> dict[str, str | float | bool]:
        """For the report: how far optical flow moved the surface, and the share that was smoothed, because the photos
        hardly determine it."""
        return {"flow_moved_mm": round(1e3 * self.flowed, 3), "smoothed_share": round(self.smoothed, 4)}

    def ask_skin(self, choices: Choices) -> None:
        """Correct the light by the skin, if photos show a face."""
        light = choices.facts.get("light", {})
        explained = light.get("explained") if choices.light_known else None
        rays = self.pixels.draw(SKIN_RAYS, 0.0, self.settings.seed).rays
        known = None if explained is None else float(explained)
        found = correct_light(self.model, self.views, rays, known, self.device, self.near_head)
        if found is not None:
            self.choices = replace(choices, facts=choices.facts | {"light": light | found.facts})
        if found is None or not found.changed:
            self.trials.withdraw(SKIN)
        else:
            self.skin_tells = True
            self.restart(self.model.light, self.model.spatial)

    def ask_second(self) -> None:
        """Correct both lights so that the two captures show one albedo."""
        found = correct_lights(self, hashed(self.model))
        self.known_of_second = self.known_of_second | found
        if found:
            self.restart(*own_lights(self.model), self.model.spatial)

    def second_facts(self) -> dict[str, str | float | bool]:
        """For the report: where the light of the second capture comes from."""
        return self.known_of_second

    def restart(self, *parts: Part) -> None:
        """Forget the momentum of parts that were set."""
        for parameter in (p for part in parts for p in part.parameters()):
            self.optimiser.state.pop(parameter, None)

    def set_rates(self) -> float:
        """Set the rates of this step; returns that of the SDF in asset units."""
        return set_rates(self)

    # ---------------------------------------------------------------- one step
    def move(self, rate: float) -> None:
        """Update the parameters. rate: of the SDF, asset units."""
        if self.model.uniform_albedo:
            for light in own_lights(self.model):
                light.uniform_gradient(UNIFORM_LIGHT_ORDER)
        self.optimiser.step()
        self.grid.step(rate)

    def tend(self) -> None:
        """Keep the residuals of the step, and find the narrow band again every BAND_EVERY steps."""
        if self.settings.weigh_photos and self.share() >= max(
            OBSERVE_FROM, self.settings.uniform_albedo_until + SETTLING
        ):
            self.robust.note(self.model)
        if self.step % BAND_EVERY == 0:
            self.grid.find_band()

    def finish(self) -> None:
        """Make the SDF a distance again, after the last step."""
        self.trials.finish(self)
        self.release()
        self.grid.redistance()

    def compute_terms(self, batch: Batch, generator: torch.Generator) -> Terms:
        """The parts of the loss. bfloat16 affects only the networks' matrix products."""
        kind, short = torch.device(self.device).type, self.settings.precision == "bfloat16"
        with torch.autocast(kind, torch.bfloat16, enabled=short):
            found = terms(self.model, batch, self.weights(), generator, 1.0 - 0.8 * self.share(), self.robust.of(batch))
        if self.settings.weigh_photos:
            self.robust.latest = None if found.seen is None else (batch, found.seen)
        return found

    def weights(self) -> Config:
        """The settings. Before the model selection F0 is free, because the light is not known yet. If it is known
        later, there is no sparse-albedo prior, which would move albedo into the lobe; nor if the light moves, which
        shows albedo and light apart. If skin or a second capture tells the light's colour, or the light is given,
        nothing draws it to white."""
        if self.light_moves:
            return self.settings.changed(albedo_sparsity=0.0)
        if self.light_given:
            return self.settings.changed(albedo_sparsity=0.0, white=0.0)
        if self.choices is None:
            return self.settings.changed(f0_excess=0.0)
        known = self.settings.changed(albedo_sparsity=0.0) if self.choices.light_known else self.settings
        return known.changed(white=0.0) if self.light_told else known

    def geometry_is_finite(self) -> bool:
        """Whether the gradients outside of the optimiser are finite."""
        return self.grid.gradient_is_finite()

    def forget(self) -> None:
        """Drop the gradients outside of the optimiser."""
        self.grid.drop_gradient()

    def own_parts(self) -> dict[str, Any]:
        """Model, choices and optimisers, for a checkpoint."""
        g = self.grid
        return {
            "level": self.level,
            "choices": self.choices.plain() if self.choices else None,
            "cell": g.cell,
            "poses": self.poses.stored(self.views),
            "known_of_second": self.known_of_second,
            "robust": self.robust.stored(),
            "model": self.model.state_dict(),
            "band": g.optimiser_state(),
            "optimiser": self.optimiser.state_dict(),
        }

    def restore_own(self, state: dict[str, Any]) -> None:
        """Inverse of `own_parts`."""
        g = self.grid
        g.cell = float(state["cell"])
        self.level = state["level"]
        self.views = self.poses.restore(self.views, state["poses"])
        self.robust.restore(state["robust"], self.device)
        self.known_of_second = state.get("known_of_second", {})  # not in checkpoints from before there was one
        if state["choices"] is not None:
            self.take(restored(state["choices"]))
        g.restore(state["model"]["geometry.values"].to(self.device))
        self.model.load_state_dict(state["model"])
        g.load_optimiser_state(state["band"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.table = None
