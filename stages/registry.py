"""The stages, in the order in which they run. This module imports fast: each stage loads its libraries when it runs.

To add a stage, write `stages/<name>/stage.py` and add its STAGE to REGISTRY at the right place. The names of its input
fields determine from which stages the inputs come (see CONTRIBUTING.md).
"""

from __future__ import annotations

from typing import Any

from pipeline.contract import Stage
from stages.bake.stage import STAGE as BAKE
from stages.capture.stage import STAGE as CAPTURE
from stages.inverse_rendering.stage import STAGE as INVERSE_RENDERING
from stages.masks.stage import STAGE as MASKS
from stages.poses.stage import STAGE as POSES
from stages.reflectance.stage import STAGE as REFLECTANCE
from stages.report.stage import STAGE as REPORT
from stages.surface.stage import STAGE as SURFACE
from stages.template.stage import STAGE as TEMPLATE
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
