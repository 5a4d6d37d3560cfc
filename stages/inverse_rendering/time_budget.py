"""Time budget of a fit with a time limit: the time for training without that for reading photos and rendering held-out
views."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch

from pipeline.artifacts import Camera
from pipeline.fields.face import FaceModel
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.load_views import camera_only
from stages.inverse_rendering.ray_sampling import factor_for, image_rays
from stages.inverse_rendering.render import render_rays

MIN_TRAINING = 0.25  # share of the stage's seconds that training always gets
TRIED = 20_000  # rays of a held-out view that are timed
FINER = 1.5  # ratio of the rendering times on the final grid and on the initial coarse grid


class Clock:
    """A stopwatch that starts when it is created. waited: seconds so far that do not count, while the run is paused."""

    def __init__(self, waited: Callable[[], float] = lambda: 0.0) -> None:
        self.begun, self.waited = time.monotonic(), waited

    def elapsed(self) -> float:
        """Seconds since the start, without those that do not count."""
        return time.monotonic() - self.begun - self.waited()


def seconds_to_predict(model: FaceModel, held: Sequence[Camera], settings: Config, device: str) -> float:
    """Estimated seconds for rendering the held-out views, by timing some of their rays. held: cameras of the photos."""
    if not held:
        return 0.0
    factors = [factor_for((c.width, c.height), settings.image_side, exact=True) for c in held]
    pixels = sum((c.width // f) * (c.height // f) for c, f in zip(held, factors, strict=True))
    rays = image_rays(camera_only(held[0]), factors[0], device)
    every = slice(None, None, max(len(rays.o) // TRIED, 1))
    some = rays[every]
    taken = []
    for _ in range(2):  # the first call includes one-time loading
        clock = Clock()
        render_rays(model, some, settings.samples)
        if device == "cuda":
            torch.cuda.synchronize()
        taken.append(clock.elapsed())
    return FINER * min(taken) * pixels / max(len(some.o), 1)
