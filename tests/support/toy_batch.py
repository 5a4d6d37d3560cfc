"""A batch whose stages are the real capture, a toy that works in steps with checkpoints, and a toy asset.

As a module it offers the flow to a Prefect worker; as a program it is `neuface` (or, with --child, one capture's
process) with these stages; with NEUFACE_REAL_STAGES in the environment, with all the real ones. Every stage that comes
to its end adds a line, its name and its key, to the file $NEUFACE_TALLY.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pipeline.threads  # noqa: F401
from pipeline.artifacts import Artifact, FileRef, Located
from pipeline.asset_artifacts import UsdAsset
from pipeline.capture_artifacts import Capture
from pipeline.contract import Context, Stage, StageConfig
from pipeline.verdict import Finding, Level
from stages import registry
from stages.capture.stage import STAGE as CAPTURE
from tests.support.points import after, before, instrument, instrument_store, reach
from tests.support.toy_stages import finding
from workflows.batch import local
from workflows.run.published import write_whole
from workflows.server import adapter


class Worked(Artifact):
    """What the toy made."""

    file: FileRef
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True, slots=True)
class WorkInputs:
    capture: Located[Capture]


@dataclass(frozen=True, slots=True)
class UsdInputs:
    work: Located[Worked]


class WorkConfig(StageConfig):
    steps: int = 4
    pause: float = 0.0  # seconds after each step
    fault: str = ""
    doubted_width: int = 0  # a capture whose photos are so wide is judged `doubted`
    doubted: Level = "unusable"


class UsdConfig(StageConfig):
    name: str = "head"
    high_faces: int = 0  # the draft preset sets it


def run_work(inputs: WorkInputs, config: WorkConfig, context: Context) -> Worked:
    """As many steps as asked, a checkpoint after each; ends as its setting says."""
    checkpoint = context.scratch / "step.txt"
    begin = int(checkpoint.read_text()) if checkpoint.is_file() else 0
    for step in range(begin, config.steps):
        context.check()
        context.progress(step, config.steps, "working")
        reach("work.step")
        write_whole(checkpoint, str(step + 1))  # as the fit's: SIGKILL leaves the old one or the new one
        reach("work.checkpoint", context.cancelled)
        time.sleep(config.pause)
    if config.fault == "hangs":
        reach("work.hangs")
        while True:
            time.sleep(0.05)
    if config.fault == "hangs in C":  # with Python's lock held: no thread of Python runs any more
        ctypes.PyDLL(None).sleep(600)
    if config.fault == "hangs politely":
        while True:
            context.check()
            time.sleep(0.05)
    if config.fault == "killed once" and not (context.scratch / "killed").exists():
        (context.scratch / "killed").write_text("")
        os.kill(os.getpid(), 9)
    (context.workdir / "w.bin").write_bytes(inputs.capture.artifact.digest().encode() * 1000)
    doubtful = inputs.capture.artifact.views[0].width == config.doubted_width
    return Worked(file=context.file("w.bin"), findings=(finding(config.doubted),) if doubtful else ())


def run_usd(inputs: UsdInputs, config: UsdConfig, context: Context) -> UsdAsset:
    """A folder that looks like an asset."""
    root = context.workdir / "asset" / f"{config.name}.usd"
    root.parent.mkdir()
    root.write_text(f'#usda 1.0\ndef "x" {{}} # {inputs.work.artifact.file.sha256}\n')
    return UsdAsset(name=config.name, root=f"asset/{config.name}.usd", files=(context.file(root),), checks=0)


def run_capture(inputs: Any, config: Any, context: Context) -> Capture:
    """The real stage without its findings: photos of noise are no good ones, and that is not what is tested here."""
    made: Capture = CAPTURE.run(inputs, config, context)
    return made.model_copy(update={"findings": ()})


TOYS: tuple[Stage[Any, Any, Any], ...] = (
    replace(CAPTURE, run=run_capture),
    Stage("work", 1, WorkInputs, WorkConfig, Worked, run_work),
    Stage("usd", 1, UsdInputs, UsdConfig, UsdAsset, run_usd),
)


def counted(stage: Stage[Any, Any, Any]) -> Stage[Any, Any, Any]:
    """The stage, with a line in the tally for each time that it comes to its end."""

    def run(inputs: Any, config: Any, context: Context) -> Artifact:
        made: Artifact = stage.run(inputs, config, context)
        path = os.environ.get("NEUFACE_TALLY")
        if path:
            with Path(path).open("a") as f:
                f.write(f"{stage.name} {context.workdir.name.partition('.')[0]}\n")
        return made

    return replace(stage, run=run)


REAL = bool(os.environ.get("NEUFACE_REAL_STAGES"))
if REAL:
    instrument()
else:
    adapter.FIT = "work"  # what holds a slot of the pool's GPUs
registry.REGISTRY = tuple(counted(s) for s in (registry.REGISTRY if REAL else TOYS))
local.CHILD = (sys.executable, str(Path(__file__).resolve()), "--child")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        from workflows.batch import child
        from workflows.run import publish

        if not REAL:  # "child.begin", "STAGE.begin", "STAGE.end", "publish.ready", "publish.done"
            instrument_store()
            child.make_plan = before("child.begin", child.make_plan)
            publish._stop_if = before("publish.ready", publish._stop_if)
            child.publish = after("publish.done", child.publish)
        sys.exit(child.main(sys.argv[2:]))
    from workflows.cli.main import main

    sys.exit(main())
else:  # what a worker's entrypoint names
    from workflows.flows import capture_to_asset, facescape_batch

    __all__ = ["capture_to_asset", "facescape_batch"]
