"""Does a stage fit into the memory? Told before it begins, and when it runs out of it.

How much a stage needs is known from earlier runs with the same settings, else from measured runs of each preset. It is
an estimate: a stage that seems too large is tried. Where the system ends the process (the kernel's OOM killer), only
what was told before is seen.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.contract import Stage, StageConfig, key, peak_memory_mb
from pipeline.errors import MemoryLimitError, NeufaceError
from pipeline.store import MANIFEST
from workflows.run.estimate import records
from workflows.run.needs import MEMORY_MB, free_memory_mb
from workflows.run.plan import Plan

RAN_OUT = re.compile(r"out of memory|allocate memory|bad_alloc|not enough memory", re.IGNORECASE)
LIGHTER: dict[str, str] = {  # settings that lower a stage's memory
    "poses": "poses.max_image_size or poses.max_features",
    "inverse_rendering": "inverse_rendering.batch, inverse_rendering.image_side or inverse_rendering.grid_cells",
    "surface": "surface.resolution",
    "bake": "bake.size",
    "usd": "bake.size or usd.preview_size",
}
CONTROL_GROUP = Path("/sys/fs/cgroup")


def needed_mb(plan: Plan, stage: str, config: StageConfig) -> float | None:
    """MB of the process at its peak in this stage; None where nothing is known."""
    earlier = [run.get("peak_memory_mb") for _, run in records(plan, stage, config)]
    known = [float(peak) for peak in earlier if isinstance(peak, int | float)]
    return max(known, default=MEMORY_MB.get(plan.request.preset, None))


def free_mb(group: Path | None = None) -> float | None:
    """MB that this process can still get: of the machine, and of its control group; None if neither is told."""
    group = group or CONTROL_GROUP
    found = [free_memory_mb()]
    try:
        limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
        found.append((limit - used) / 2**20)
    except (OSError, ValueError):  # no control group, or one without a limit ("max")
        pass
    return min((f for f in found if f is not None), default=None)


def remedy(stage: str) -> str:
    """What makes the stage smaller."""
    own = LIGHTER.get(stage)
    return (f"lower {own}, " if own else "") + "use a smaller preset (--preset draft), or end other programs"


@contextmanager
def within_memory(
    plan: Plan, stage: Stage[Any, Any, Any], inputs: Any, config: StageConfig, note: Callable[[str], None]
) -> Iterator[None]:  # fmt: skip
    """Around a stage: a word before it where more memory is needed than is free, and a named error where it ran out.

    Raises:
        MemoryLimitError: the stage did not fit.
    """
    if (plan.store.folder(stage.name, key(stage, inputs, config)) / MANIFEST).is_file():
        yield
        return
    needed, free = needed_mb(plan, stage.name, config), free_mb()
    if needed is not None and free is not None and needed > free + peak_memory_mb():
        note(f"{stage.name} needs about {needed / 1024:.1f} GB of memory, and {free / 1024:.1f} GB are free; if it "
             f"does not fit: {remedy(stage.name)}")  # fmt: skip
    try:
        yield
    except NeufaceError:
        raise
    except Exception as e:
        if not isinstance(e, MemoryError) and not RAN_OUT.search(str(e)):
            raise
        raise MemoryLimitError(
            f"the stage {stage.name} ran out of memory",
            where=stage.name,
            value=f"{peak_memory_mb() / 1024:.1f} GB in use, {'unknown' if free is None else f'{free / 1024:.1f} GB'} "
            f"free when it began ({type(e).__name__}: {str(e)[:200]})",
            limit="about " + ("an unknown amount" if needed is None else f"{needed / 1024:.1f} GB") + " is needed",
            remedy=f"{remedy(stage.name)}; finished stages are kept",
        ) from e
