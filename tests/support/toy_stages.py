"""Three tiny stages, to test the machinery around stages without doing any of their work.

Run as a script it executes them in a store, as a process that a test may kill.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import Field

from pipeline.artifacts import Artifact, FileRef, Located
from pipeline.contract import Context, Stage, StageConfig, execute, inputs_from
from pipeline.errors import StageError
from pipeline.store import Store
from pipeline.verdict import Finding, Level, Limits, judged
from tests.support.points import reach


class Folder(Artifact):
    """What the toy source holds."""

    files: tuple[FileRef, ...]


class Number(Artifact):
    """A sum, and the file that it is written in."""

    total: int
    file: FileRef
    warnings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class FirstInputs:
    source: Located[Folder]


@dataclass(frozen=True, slots=True)
class SecondInputs:
    first: Located[Number]


@dataclass(frozen=True, slots=True)
class ThirdInputs:
    first: Located[Number]
    second: Located[Number]


class Config(StageConfig):
    plus: int = Field(0, ge=0, le=1000, description="what is added")
    seed: int = 0
    holdout: str = "none"
    fault: str = ""
    level: Level | None = Field(None, description="how the toy judges its own result")


class SlowConfig(Config):
    steps: int = Field(1, ge=1, description="files that are written one after the other")
    pause: float = Field(0.0, ge=0, description="seconds between them, for a stage that is still at work")


def source(folder: Path) -> Located[Folder]:
    """Hash a folder's files."""
    return Located(Folder(files=tuple(FileRef.of(folder, p) for p in sorted(folder.iterdir()))), folder)


def _write(context: Context, total: int, level: Level | None = None) -> Number:
    (context.workdir / "total.txt").write_text(f"{total}\n" * 1000)
    return Number(total=total, file=context.file("total.txt"), findings=() if level is None else (finding(level),))


def finding(level: Level, check: str = "toy_share") -> Finding:
    """A share of three toys with limits at 0.9 and 0.5."""
    value = {"good": 0.95, "usable": 0.7, "unusable": 0.2}[level]
    said = f"{100 * value:.0f} % of the toys are whole."
    return judged(check, value, Limits(0.9, 0.5), said, "take the broken toys again", views=["a.jpg", "b.jpg"])


def run_first(inputs: FirstInputs, config: Config, context: Context) -> Number:
    """Sum of the files' sizes."""
    if config.fault:
        raise StageError("the first toy is broken", where="part 1", value=3, limit="4", remedy="mend it")
    return _write(context, sum(f.size for f in inputs.source.artifact.files) + config.plus, config.level)


def run_second(inputs: SecondInputs, config: SlowConfig, context: Context) -> Number:
    """Slow, with a checkpoint after every step; fails as its config says."""
    checkpoint = context.scratch / "step.txt"
    begin = int(checkpoint.read_text()) if checkpoint.is_file() else 0
    for step in range(begin, config.steps):
        context.check()
        context.progress(step, config.steps, "working", loss=1 / (step + 1))
        (context.workdir / f"part{step}.bin").write_bytes(bytes(100_000))
        reach("second.step")
        time.sleep(config.pause)
        checkpoint.write_text(str(step + 1))
    if config.fault == "stage":
        raise StageError("the toy is broken", where="part 7", value=3, limit="4", remedy="mend it")
    if config.fault == "space":
        raise OSError(28, "No space left on device", str(context.workdir / "part.bin"))
    if config.fault == "bug":
        raise ZeroDivisionError("a bug of the stage")
    if config.fault == "manifest":
        number = _write(context, 1)
        (context.workdir / "total.txt").write_text("changed after it was hashed")
        return number
    return _write(context, inputs.first.artifact.total + config.plus, config.level)


def run_third(inputs: ThirdInputs, config: Config, context: Context) -> Number:
    """Sum of both."""
    total = inputs.first.artifact.total + inputs.second.artifact.total + config.plus
    return _write(context, total, config.level)


FIRST: Stage[Any, Any, Any] = Stage("first", 1, FirstInputs, Config, Number, run_first)
SECOND: Stage[Any, Any, Any] = Stage("second", 1, SecondInputs, SlowConfig, Number, run_second)
THIRD: Stage[Any, Any, Any] = Stage("third", 1, ThirdInputs, Config, Number, run_third)
TOYS = (FIRST, SECOND, THIRD)


def main() -> int:
    """Run the toys in a store; prints `stage reused|made` for each."""
    p = argparse.ArgumentParser()
    p.add_argument("folder", type=Path)
    p.add_argument("store", type=Path)
    p.add_argument("--steps", type=int, default=1)
    p.add_argument("--seed", type=int, default=0)
    options = p.parse_args()
    finished: dict[str, Located[Any]] = {"source": source(options.folder)}
    slow = SlowConfig(steps=options.steps, seed=options.seed)
    for stage in TOYS:
        config = slow if stage is SECOND else Config()
        done = execute(stage, inputs_from(stage, finished), config, Store(options.store))
        finished[stage.name] = done.located
        print(stage.name, "reused" if done.reused else "made", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
