"""What a run at work tells the folder OUT/live: how far it is, its figures, and pictures.

It observes a run beside the console, and changes nothing of it. A fault here, such as a full disk, ends the telling and
not the run.
"""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from pipeline.artifacts import Located
from pipeline.contract import Done, Picture
from pipeline.errors import Cancelled, NeufaceError
from workflows.live.folder import LiveFolder
from workflows.live.pictures import drawn, jpeg
from workflows.live.wishes import Wishes
from workflows.run.estimate import expected
from workflows.run.forecast import Forecast
from workflows.run.plan import Plan
from workflows.run.request import RunRequest
from workflows.run.session import Observer, Session
from workflows.run.steering import OFFERED_MINUTES, OFFERED_PRESETS

log = logging.getLogger(__name__)
EVERY = 1.0  # seconds between two writings of state.json
PREVIEW_EVERY = 10.0  # seconds of the fit between two pictures of it
PREVIEW_SHARE = 0.03  # largest share of the fit's time for them
CURVE = 300  # points of the curve; then every second one is left out
NOTES = 30


@contextmanager
def told_live(plan: Plan, watch: Session) -> Iterator[Session]:
    """A session that also tells OUT/live what happens, and that takes wishes from there. Call with the lock of OUT.

    Where the folder can't be used, or the request does not want it, it is the given session.
    """
    if plan.request.no_live:
        yield watch
        return
    try:
        live = Live(plan, watch)
    except OSError as e:
        watch.observer.note(f"no live view: {e}")
        yield watch
        return
    watch.steering.ask = live.wishes
    try:
        yield replace(watch, observer=live, show=live.show)
    except BaseException as e:
        live.end(e)
        raise
    else:
        live.end(None)
    finally:
        watch.steering.ask = lambda: None


class Live:
    """An Observer in front of another one."""

    def __init__(self, plan: Plan, watch: Session, clock: Callable[[], float] = time.monotonic) -> None:
        self.inner: Observer = watch.observer
        self.steering, self._clock = watch.steering, clock
        self.folder = LiveFolder(plan.out, watch.observer.note)
        self.run = secrets.token_hex(8)
        self.wishes = Wishes(plan.out, self.run)
        self._lock = threading.RLock()
        self._finished: dict[str, Located[Any]] = {}
        self._pending: list[str] = []
        self._works, self._written, self._next_preview = True, -math.inf, 0.0
        seconds = {e.step.stage: e.seconds for e in expected(plan)}
        self.forecast = Forecast(seconds, self._now(), plan.request.budget)
        photos = plan.request.whole_paths()
        self.state: dict[str, Any] = {
            "run": self.run, "out": str(plan.out.resolve()), "store": str(plan.store.root.resolve()),
            "capture": photos["capture"], "also": photos.get("also"),
            "preset": plan.request.preset, "budget": plan.request.budget,
            "began": time.time(), "status": "running",
            "stages": [{"name": s.name, "state": "waiting", "share": 0.0, "seconds": None} for s in plan.stages],
            "message": "", "figures": {}, "presets": OFFERED_PRESETS, "minutes": OFFERED_MINUTES,
            "curve": [], "notes": [], "warnings": [], "pictures": {},
        }  # fmt: skip
        self._write()

    # ------------------------------------------------------------------ as an Observer
    def started(self, stage: str, number: int, of: int) -> None:
        """A stage begins."""
        with self._lock:
            self.forecast.started(stage, self._now())
            self._next_preview = self._now()
            self._stage(stage, state="running", share=0.0)
            self.state |= {"message": "", "figures": {}}
            self._write()
        self.inner.started(stage, number, of)

    def progress(self, done: int, total: int, message: str = "", **figures: float) -> None:
        """How far the stage is. The first one of a stage that is really at work draws what earlier stages left."""
        self.inner.progress(done, total, message, **figures)
        with self._lock:
            now = self._now()
            self.forecast.progress(done, total, message, now)
            if "psnr" in figures and math.isfinite(figures["psnr"]):
                self._point(done, figures["psnr"])
            if self._pending:
                self._draw()
            elif now - self._written < EVERY:
                return
            known = {k: round(v, 6) for k, v in figures.items() if math.isfinite(v)}
            self.state |= {"message": message, "figures": known}
            running = next((s for s in self.state["stages"] if s["state"] == "running"), None)
            if running is not None:
                running["share"] = round(self.forecast.stage_share, 4)
            self._write()

    def finished(self, done: Done[Any]) -> None:
        """The stage is done."""
        with self._lock:
            self.forecast.finished(done.stage, self._now(), reused=done.reused)
            seconds = float(done.run.get("seconds", 0.0))
            self._stage(done.stage, state="reused" if done.reused else "done", share=1.0, seconds=seconds)
            self._finished[done.stage] = done.located
            self._pending.append(done.stage)
            new = [f"{done.stage}: {w}" for w in getattr(done.located.artifact, "warnings", ())]
            self.state["warnings"] = [*self.state["warnings"], *new][-NOTES:]
            if not done.reused:
                self._draw()
            self._write()
        self.inner.finished(done)

    def paused(self, waits: bool) -> None:
        """The stage waits, or goes on."""
        with self._lock:
            self._write()
        self.inner.paused(waits)

    def replanned(self, seconds: Mapping[str, float | None], request: RunRequest) -> None:
        """The run begins again with another preset or budget; pictures of finished stages stay."""
        with self._lock:
            self.forecast = Forecast(seconds, self._now(), request.budget)
            stages = [{**s, "state": "waiting", "share": 0.0, "seconds": None} for s in self.state["stages"]]
            new = {"preset": request.preset, "budget": request.budget, "stages": stages}
            self.state |= {**new, "curve": [], "message": "", "figures": {}}
            self._write()
        self.inner.replanned(seconds, request)

    def note(self, text: str) -> None:
        """A message for the user."""
        with self._lock:
            self.state["notes"] = [*self.state["notes"], text.strip()][-NOTES:]
            self._write()
        self.inner.note(text)

    # ------------------------------------------------------------------ pictures
    def show(self, name: str, make: Picture) -> float:
        """A picture of the stage at work, every PREVIEW_EVERY seconds, or less often where it takes long."""
        with self._lock:
            if not self._works or self._now() < self._next_preview:
                return 0.0
            begun = self._clock()
            image = make()
            self._picture(f"{name}.jpg", jpeg(image), "left a fitted photo, right the model")
            taken = self._clock() - begun
            self._next_preview = self._now() + max(PREVIEW_EVERY - taken, taken / PREVIEW_SHARE)
            self._write()
            return taken

    def _draw(self) -> None:
        for stage in self._pending:
            try:
                found = drawn(stage, self._finished)
                if found is not None:
                    self._picture(found.name, found.data, found.caption)
            except Exception as e:  # only for display: a picture that can't be made must not fail the run
                log.warning("no picture of %s: %s", stage, e)
        self._pending.clear()

    def _picture(self, name: str, data: bytes, caption: str) -> None:
        number = self.state["pictures"].get(name, {}).get("number", 0) + 1
        self._do(lambda: self.folder.write(name, data))
        self.state["pictures"][name] = {"number": number, "caption": caption}

    def _point(self, step: int, psnr: float) -> None:
        curve: list[list[float]] = self.state["curve"]
        curve.append([step, round(psnr, 3)])
        if len(curve) > CURVE:
            self.state["curve"] = curve[::2]

    # ------------------------------------------------------------------ state.json
    def end(self, error: BaseException | None) -> None:
        """The run ends. What it published says all that was told here; else why it ended stays to be read, where any
        stage was finished."""
        with self._lock:
            self._works = True
            if error is None or not self._finished:
                self._do(self.folder.remove)
                self._works = False
                return
            known = isinstance(error, NeufaceError | KeyboardInterrupt)
            stopped = isinstance(error, Cancelled | KeyboardInterrupt)
            text = str(error) if known else f"{type(error).__name__}: {error}"
            for stage in self.state["stages"]:
                stage["state"] = "stopped" if stage["state"] == "running" else stage["state"]
            self.state |= {"status": "stopped" if stopped else "failed", "message": text}
            self._write()
            self._works = False

    def _stage(self, name: str, **values: Any) -> None:
        for stage in self.state["stages"]:
            if stage["name"] == name:
                stage.update(values)

    def _write(self) -> None:
        now = self._now()
        if self.state["status"] not in ("stopped", "failed"):
            s = self.steering
            self.state["status"] = "paused" if s.paused else "pausing" if s.pausing else "running"
            if s.ends_after_stage.is_set() and not s.pausing:
                self.state["status"] = "stops after the stage"
        rest = self.forecast.remaining(now)
        self.state |= {
            "changeable": self.steering.changeable,
            "percent": round(100 * self.forecast.share_of_run(now), 1),
            "remaining": None if rest is None else round(rest, 1),
            "elapsed": round(now - self.forecast.begun, 1),
            "updated": time.time(),
        }
        self._written = now
        self._do(lambda: self.folder.state(self.state))

    def _do(self, work: Callable[[], None]) -> None:
        """Write something, unless that failed before."""
        if not self._works:
            return
        try:
            work()
        except OSError as e:
            self._works = False
            log.warning("the live view ends: %s", e)

    def _now(self) -> float:
        """Seconds without those for which the run was paused."""
        return self._clock() - self.steering.waited()


def told(state: Mapping[str, Any]) -> bool:
    """Whether a state.json is whole enough to be shown."""
    with suppress(AttributeError, TypeError, KeyError):
        return isinstance(state["stages"], list) and all({"name", "state"} <= s.keys() for s in state["stages"])
    return False
