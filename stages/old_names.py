"""Names of settings that an earlier version had: accepted for one release, with a hint in place of an error.

Remove this release's entries when the next one is out.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any

log = logging.getLogger("neuface.settings")

# stage.old -> the new name in the same stage; none that names a file, which workflows/access.py would not find
RENAMED: dict[str, str] = {}
REMOVED = frozenset(  # constants of the code by now: nobody set them
    {
        "poses.shared_intrinsics",
        "poses.refine_focal",
        "poses.refine_distortion",
        "poses.refine_principal_point",
        "poses.use_masks",
        "poses.min_registered",
        "masks.working_size",
        "masks.min_agreement",
        "masks.max_deviation",
        "inverse_rendering.even_from",
        "inverse_rendering.open_from",
        "inverse_rendering.open_until",
        "uv.iterations",
        "report.picture_side",
        "report.views_shown",
        "report.masks_shown",
    }
)


def without_old_names(stage: str, values: Mapping[str, Any], names: Collection[str], origin: str) -> dict[str, Any]:
    """The values of a stage by today's names. names: those of today, which are never taken for old ones. A value under
    today's name wins over one under the old. origin: where the user wrote them, for the hint."""
    out = {k: v for k, v in values.items() if k in names}
    for name in values.keys() - out.keys():
        path = f"{stage}.{name}"
        if path in RENAMED:
            _hint(f"{origin} {path} is called {stage}.{RENAMED[path]} now; the old name will go in the next release")
            out.setdefault(RENAMED[path], values[name])
        elif path in REMOVED:
            _hint(f"{origin} {path} is no longer a setting; ignored (`neuface settings {stage}` lists those there are)")
        else:
            out[name] = values[name]
    return out


@cache
def _hint(text: str) -> None:
    """Once in a process: a run puts its settings together more than once."""
    log.warning(text)
