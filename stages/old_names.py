"""Names of settings and values that an earlier version had: accepted for one release, with a hint in place of an error.

Remove this release's entries when the next one is out.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any

log = logging.getLogger("neuface.settings")

# stage.old -> the new name in the same stage; none that names a file, which workflows/server/access.py would not find
RENAMED: dict[str, str] = {
    "capture.chart": "colour_checker",
    "poses.patience": "attempts",
    "masks.mend": "resegment",
    "inverse_rendering.relief": "refine_geometry",
    "inverse_rendering.even_until": "uniform_albedo_until",
    "inverse_rendering.shininess": "shininess_prior",
    "inverse_rendering.parsimony": "albedo_sparsity",
}
# stage.setting -> old value -> new value
RENAMED_VALUES: dict[str, dict[str, str]] = {
    "inverse_rendering.light_from": {"even": "uniform_albedo"},
    "uv.remesh": {"even": "uniform"},
}
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
    out = {k: _todays_value(f"{stage}.{k}", v, origin) for k, v in values.items() if k in names}
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


def _todays_value(path: str, value: Any, origin: str) -> Any:
    """The value under its name of today."""
    new = RENAMED_VALUES.get(path, {}).get(value) if isinstance(value, str) else None
    if new is None:
        return value
    _hint(f"{origin} {path}={value} is called {path}={new} now; the old name will go in the next release")
    return new


@cache
def _hint(text: str) -> None:
    """Once in a process: a run puts its settings together more than once."""
    log.warning(text)
