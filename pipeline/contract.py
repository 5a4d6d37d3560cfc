"""The stage contract: a stage is a pure function from artifacts and a config to an artifact.

`key` is a hash of content (stage, version, config, the inputs' manifests) and of the number of threads where results
depend on it, never of paths or times. `execute` looks up
the key in the store. If it is missing, it runs the stage in a partial folder and completes the result by one rename.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import importlib.metadata
import json
import logging
import platform
import resource
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from pipeline import threads
from pipeline.artifacts import Artifact, FileRef, Located
from pipeline.errors import Cancelled, NeufaceError, stage_error_from_os_error
from pipeline.memory import give_back
from pipeline.store import Store
from pipeline.units import FilledIn

log = logging.getLogger(__name__)
FULL = 1 << 16  # bytes free on a disk below which a library's failure to write is put down to it


class StageConfig(BaseModel):
    """Base of every stage's settings. All fields enter the key: only settings that affect the result belong here."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def setting_names(cls) -> tuple[str, ...]:
        """The settings for users: every field except those that the stage fills in itself."""
        return tuple(
            name for name, field in cls.model_fields.items() if not any(isinstance(m, FilledIn) for m in field.metadata)
        )

    def made_from(self) -> dict[str, Path]:
        """Folders that settings name and that the result is made from, by setting: they enter the lineage."""
        return {}

    def changed(self, **values: object) -> Self:
        """A copy with other values, like dataclasses.replace: the values are not compared with the limits.

        Raises:
            TypeError: a name is not a setting.
        """
        unknown = values.keys() - type(self).model_fields.keys()
        if unknown:
            raise TypeError(f"not settings of {type(self).__module__}: {', '.join(sorted(unknown))}")
        return self.model_copy(update=values)


class Progress(Protocol):
    """Callback for the progress of a stage: `done` of `total`, and figures to show (loss, psnr, ...)."""

    def __call__(self, done: int, total: int, message: str = "", **figures: float) -> None: ...


def no_progress(done: int, total: int, message: str = "", **figures: float) -> None:
    """A Progress that does nothing."""


def never_cancelled() -> bool:
    """A cancel check for runs that can't be cancelled."""
    return False


Picture = Callable[[], npt.NDArray[np.uint8]]  # makes an 8-bit sRGB picture (H, W, 3)


class Show(Protocol):
    """Callback for pictures of a stage at work. Whoever watches decides how often `make` is called, if ever; what it
    takes must change nothing of the stage. Returns the seconds that it took, 0 if it was not called."""

    def __call__(self, name: str, make: Picture) -> float: ...


def no_show(name: str, make: Picture) -> float:
    """A Show that calls nothing."""
    return 0.0


class Checked:
    """A cancel check that counts the time spent in it: where a run is paused, its stage waits there."""

    def __init__(self, cancelled: Callable[[], bool]) -> None:
        self._cancelled, self._lock = cancelled, threading.Lock()
        self._inside, self._since, self._spent = 0, 0.0, 0.0

    def __call__(self) -> bool:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                self._since = time.perf_counter()
        try:
            return self._cancelled()
        finally:
            with self._lock:
                self._inside -= 1
                if self._inside == 0:
                    self._spent += time.perf_counter() - self._since

    def waited(self) -> float:
        """Seconds during which any thread was in the check."""
        with self._lock:
            return self._spent + (time.perf_counter() - self._since if self._inside else 0.0)


@dataclass(frozen=True, slots=True)
class Context:
    """The environment of a stage, besides inputs and config.

    workdir: empty, becomes the artifact's folder. scratch: for checkpoints; it is kept if a run with the same key is
    killed. device: "cpu" or "cuda"; it only changes rounding, so it is recorded but not part of the key. show: takes
    pictures of the work. waited: seconds so far that the run was paused in this stage.
    """

    workdir: Path
    scratch: Path
    device: str = "cpu"
    progress: Progress = no_progress
    cancelled: Callable[[], bool] = never_cancelled
    log: logging.Logger = field(default_factory=lambda: logging.getLogger("neuface"))
    show: Show = no_show
    waited: Callable[[], float] = lambda: 0.0

    def file(self, path: Path | str) -> FileRef:
        """A reference to a file in workdir."""
        return FileRef.of(self.workdir, path)

    def check(self) -> None:
        """Raise Cancelled if the user stopped the run."""
        if self.cancelled():
            raise Cancelled("stopped by the user; finished stages and checkpoints are kept")


I = TypeVar("I")  # noqa: E741  (a frozen dataclass whose fields are Located artifacts, named by the stage they are from)
C = TypeVar("C", bound=StageConfig)
O = TypeVar("O", bound=Artifact)  # noqa: E741


@dataclass(frozen=True, slots=True)
class Stage(Generic[I, C, O]):
    """A step of the pipeline. Increase `version` when the meaning of its output changes.

    variants: further classes of settings, by the value of the setting `preset` that selects them; each extends
    `config`, and is only imported when it is selected or listed. any_threads: the result has the same bytes with any
    number of threads; else the number is part of the key.
    """

    name: str
    version: int
    inputs: type[I]
    config: type[C]
    output: type[O]
    run: Callable[[I, C, Context], O]
    variants: Mapping[str, Callable[[], type[C]]] = field(default_factory=dict)
    any_threads: bool = False

    def config_for(self, preset: object) -> type[C]:
        """The class of the settings for a value of `preset`; `config` if no variant has that name."""
        variant = self.variants.get(str(preset))
        return variant() if variant else self.config

    def configs(self) -> tuple[type[C], ...]:
        """Every class of settings, `config` first."""
        return tuple(dict.fromkeys((self.config, *(variant() for variant in self.variants.values()))))


@dataclass(frozen=True, slots=True)
class Done(Generic[O]):
    """A finished stage: its artifact, its folder, and the record of the run (time, memory, versions)."""

    stage: str
    key: str
    located: Located[O]
    reused: bool
    run: dict[str, Any]


def inputs_from(stage: Stage[I, C, O], finished: Mapping[str, Located[Artifact]]) -> I:
    """A stage's inputs, selected by name from the artifacts of the stages before it."""
    return stage.inputs(**{f.name: finished[f.name] for f in dataclasses.fields(stage.inputs)})  # type: ignore[arg-type]


def key(stage: Stage[I, C, O], inputs: I, config: C) -> str:
    """Content key, 64 hex digits."""
    named = {f.name: getattr(inputs, f.name).artifact.digest() for f in dataclasses.fields(inputs)}  # type: ignore[arg-type]
    parts = {"stage": stage.name, "version": stage.version, "config": config.model_dump(mode="json"), "inputs": named}
    if not stage.any_threads:
        parts["threads"] = threads.in_use()
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def execute(
    stage: Stage[I, C, O],
    inputs: I,
    config: C,
    store: Store,
    *,
    device: str = "cpu",
    progress: Progress = no_progress,
    cancelled: Callable[[], bool] = never_cancelled,
    show: Show = no_show,
) -> Done[O]:
    """Run a stage, or return its result from the store. The time in which `cancelled` waits, while the run is paused,
    is not counted in the record's seconds.

    Raises:
        StageError: invalid input or a disk error; incomplete results are removed.
        Cancelled: the user stopped it; checkpoints in scratch are kept.
    """
    k = key(stage, inputs, config)
    with store.lock(stage.name, k), _disk_faults(store.root):
        read = {f.name: getattr(inputs, f.name).origin for f in dataclasses.fields(inputs)}  # type: ignore[arg-type]
        store.trace(stage.name, k, read | config.made_from())
        found = store.load(stage.name, k, stage.output)
        if found is not None:
            log.info("%s: reused %s", stage.name, k[:12])
            return Done(stage.name, k, found, True, store.load_run(stage.name, k))
        start = time.perf_counter()
        with _folders(store, stage.name, k) as (partial, scratch):
            checked, log_of = Checked(cancelled), logging.getLogger(f"neuface.{stage.name}")
            context = Context(partial, scratch, device, progress, checked, log_of, show, checked.waited)
            context.check()
            artifact = stage.run(inputs, config, context)
            give_back()
            run: dict[str, Any] = {
                "seconds": round(time.perf_counter() - start - checked.waited(), 3),
                "peak_memory_mb": peak_memory_mb(),
                "device": device,
                "threads": threads.in_use(),
                "config": config.model_dump(mode="json"),
                "versions": versions(),
            }
            located = store.finish(stage.name, k, partial, artifact, run)
    log.info("%s: done in %.1f s, %s", stage.name, run["seconds"], k[:12])
    return Done(stage.name, k, located, False, run)


@contextmanager
def _disk_faults(root: Path) -> Iterator[None]:
    """Turns a disk fault into an error with a remedy."""
    try:
        yield
    except OSError as e:
        raise stage_error_from_os_error(e, root) or e from e


@contextmanager
def _folders(store: Store, stage: str, k: str) -> Iterator[tuple[Path, Path]]:
    """A new partial folder and the scratch folder of a key. On any failure the partial one is removed, and the scratch
    one if it is empty."""
    partial, scratch = store.begin(stage, k), store.scratch(stage, k)
    scratch.mkdir(parents=True, exist_ok=True)
    try:
        yield partial, scratch
    except BaseException as e:
        full = not isinstance(e, OSError | NeufaceError) and isinstance(e, Exception) and _is_full(partial)
        shutil.rmtree(partial, ignore_errors=True)
        if scratch.is_dir() and not any(scratch.iterdir()):
            scratch.rmdir()
        if full:  # libraries in C++ tell it in ways of their own
            raise OSError(errno.ENOSPC, f"{type(e).__name__}: {e}") from e
        raise


def _is_full(folder: Path) -> bool:
    try:
        total, _, free = shutil.disk_usage(folder)
    except OSError:
        return False
    return total > 0 and free < FULL


def peak_memory_mb() -> float:
    """Peak resident memory of this process, in MB."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1)


def versions() -> dict[str, str]:
    """Versions of the software that a result may depend on."""
    names = ("neuface-asset", "torch", "numpy", "pycolmap", "opencv-contrib-python-headless", "xatlas", "usd-core")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
