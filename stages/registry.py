"""The stages, in the order in which they run. This module imports fast: each stage loads its libraries when it runs.

To add a stage, write `stages/<name>/stage.py` and add its STAGE to REGISTRY at the right place. The names of its input
fields determine from which stages the inputs come (see CONTRIBUTING.md).
"""

from __future__ import annotations

from dataclasses import fields, make_dataclass, replace
from typing import Any

from pipeline.contract import Stage
from stages.bake.stage import STAGE as BAKE
from stages.capture.stage import STAGE as CAPTURE
from stages.inverse_rendering.stage import BOTH
from stages.inverse_rendering.stage import STAGE as INVERSE_RENDERING
from stages.masks.stage import STAGE as MASKS
from stages.poses.stage import STAGE as POSES
from stages.reflectance.stage import STAGE as REFLECTANCE
from stages.report.stage import STAGE as REPORT
from stages.surface.stage import STAGE as SURFACE
from stages.template.stage import STAGE as TEMPLATE
from stages.together.stage import STAGE as TOGETHER
from stages.usd.stage import STAGE as USD
from stages.uv.stage import STAGE as UV

SOURCE = "source"  # contents of the user's folder: the input of the first stage
FIT = INVERSE_RENDERING.name  # the stage that uses the GPU, its concurrency limit and the time budget

REGISTRY: tuple[Stage[Any, Any, Any], ...] = (
    CAPTURE,
    POSES,
    MASKS,
    INVERSE_RENDERING,
    SURFACE,
    TEMPLATE,
    UV,
    REFLECTANCE,
    BAKE,
    USD,
    REPORT,
)

ALSO = "also_"  # before the names of the second capture's stages and of its source
EVERY = (*REGISTRY, TOGETHER)  # those that have a page and settings of their own


def with_second() -> tuple[Stage[Any, Any, Any], ...]:
    """The stages of a run on two captures of one subject: before the fit, the second capture goes through the same
    stages under names of its own, and is placed beside the first."""
    out: list[Stage[Any, Any, Any]] = []
    for stage in REGISTRY:
        if stage.name == FIT:
            out += [*(of_second(s) for s in out), TOGETHER, BOTH]
        else:
            out.append(stage)
    return tuple(out)


def of_second(stage: Stage[Any, Any, Any]) -> Stage[Any, Any, Any]:
    """The same stage for the second capture: its name and its inputs begin with ALSO."""
    names = [f.name for f in fields(stage.inputs)]
    inputs = make_dataclass(f"Also{stage.inputs.__name__}", [(ALSO + n, Any) for n in names], frozen=True)

    def run(given: Any, config: Any, context: Any) -> Any:
        return stage.run(stage.inputs(**{n: getattr(given, ALSO + n) for n in names}), config, context)

    return replace(stage, name=ALSO + stage.name, inputs=inputs, run=run)
