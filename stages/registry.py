"""The stages, in the order they run. Importing this is cheap: each stage loads its libraries when it works.

To add a stage, write `stages/<name>/stage.py` and put its STAGE where it belongs in REGISTRY; its inputs are wired by
the names of their fields (see CONTRIBUTING.md).
"""

from __future__ import annotations

from typing import Any

from pipeline.contract import Stage
from stages.bake.stage import STAGE as BAKE
from stages.capture.stage import STAGE as CAPTURE
from stages.inverse_rendering.stage import STAGE as INVERSE_RENDERING
from stages.masks.stage import STAGE as MASKS
from stages.poses.stage import STAGE as POSES
from stages.report.stage import STAGE as REPORT
from stages.surface.stage import STAGE as SURFACE
from stages.usd.stage import STAGE as USD
from stages.uv.stage import STAGE as UV

SOURCE = "source"  # what the user's folder holds: the input of the first stage, made by no stage
FIT = INVERSE_RENDERING.name  # what a GPU, a slot and a budget are for

REGISTRY: tuple[Stage[Any, Any, Any], ...] = (
    CAPTURE,
    POSES,
    MASKS,
    INVERSE_RENDERING,
    SURFACE,
    UV,
    BAKE,
    USD,
    REPORT,
)
