"""Run one stage alone, without Prefect. The results of the stages before it are read from the store.

    python -m stages NAME CAPTURE --out DIR [--store DIR] [--preset P] [--set stage.key=value] [...]

For work on a stage: everything runs as plain function calls, which suits a debugger and a profiler.
"""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

import argparse
import logging
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.artifacts import Artifact, Located
from pipeline.contract import Done, Stage, StageConfig, execute, inputs_from, key
from pipeline.errors import NeufaceError, StageError
from pipeline.store import Store
from stages.presets import DEFAULT_PRESET, PRESETS, configs_for, known, parse_sets, read_config_file
from stages.registry import REGISTRY, SOURCE


def before(name: str) -> list[Stage[Any, Any, Any]]:
    """All stages that a stage depends on, in the order in which they run."""
    by_name = {s.name: s for s in REGISTRY}
    wanted, found = [name], set()
    while wanted:
        for field in by_name[wanted.pop()].inputs.__dataclass_fields__:
            if field != SOURCE and field not in found:
                found.add(field)
                wanted.append(field)
    return [s for s in REGISTRY if s.name in found]


def run_one(
    name: str, source: Located[Any], configs: Mapping[str, StageConfig], store: Store, device: str, again: bool = False
) -> Done[Any]:
    """Run the stage `name`; the results of the stages before it must be in the store.

    Raises:
        StageError: the result of a stage before it is missing, or the stage itself fails.
    """
    finished: dict[str, Located[Artifact]] = {SOURCE: source}
    for stage in before(name):
        k = key(stage, inputs_from(stage, finished), configs[stage.name])
        found = store.load(stage.name, k, stage.output)
        if found is None:
            raise StageError(
                "a stage before this one has not run with these settings",
                where=stage.name,
                value=f"nothing at {store.folder(stage.name, k)}",
                limit="a finished artifact",
                remedy=f"run it first: python -m stages {stage.name} ... with the same settings",
            )
        finished[stage.name] = found
    stage = next(s for s in REGISTRY if s.name == name)
    inputs, config = inputs_from(stage, finished), configs[name]
    if again:
        store.forget(name, key(stage, inputs, config))
    return execute(stage, inputs, config, store, device=device, progress=Lines(name))


class Lines:
    """Prints the progress as one line every two seconds."""

    def __init__(self, stage: str) -> None:
        self.stage, self.last = stage, 0.0

    def __call__(self, done: int, total: int, message: str = "", **figures: float) -> None:
        if time.monotonic() - self.last < 2 and done < total:
            return
        self.last = time.monotonic()
        shown = "  ".join(f"{k} {v:.4g}" for k, v in figures.items())
        print(f"{self.stage} {done}/{total} {message} {shown}".rstrip(), file=sys.stderr, flush=True)


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    p = argparse.ArgumentParser(prog="python -m stages", description="Run one stage alone, without Prefect.")
    p.add_argument("name", help="one of: " + ", ".join(s.name for s in REGISTRY))
    p.add_argument("capture", type=Path, help="the capture's folder")
    p.add_argument("--out", type=Path, required=True, help="as in `neuface run`: the store is OUT/.store")
    p.add_argument("--store", type=Path, help="folder of another store")
    p.add_argument("--preset", default=DEFAULT_PRESET, help=", ".join(PRESETS))
    p.add_argument("--holdout")
    p.add_argument("--asset-name", help="the asset's name")
    p.add_argument("--seed", type=int)
    p.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    p.add_argument("--set", action="append", default=[], metavar="STAGE.KEY=VALUE")
    p.add_argument("--config", type=Path, metavar="FILE")
    p.add_argument("--again", action="store_true", help="run it even if the store has the result")
    return p


def main(arguments: list[str] | None = None) -> int:
    """Return the exit code, as `neuface` does: 0 done, 1 failed, 2 wrong usage."""
    options = parser().parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        from stages.capture.scan import scan_capture

        known(options.name, [s.name for s in REGISTRY], what="unknown stage", where="NAME")
        configs = configs_for(
            options.preset,
            parse_sets(options.set),
            read_config_file(options.config) if options.config else {},
            holdout=options.holdout,
            name=options.asset_name,
            seed=options.seed,
        )
        store = Store(options.store or options.out / ".store")
        source = scan_capture(options.capture.absolute())
        done = run_one(options.name, source, configs, store, options.device, options.again)
    except NeufaceError as e:
        print(f"error: {e}", file=sys.stderr)
        return e.exit_code
    print(f"{done.located.folder}\n{'reused' if done.reused else 'made in {} s'.format(done.run['seconds'])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
