"""Old names of settings and values. They are accepted for one release, with a warning instead of an error.

Remove the entries of this release when the next one is published.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from functools import cache
from typing import Any

log = logging.getLogger("neuface.settings")

# stage.old -> new name in the same stage. Never a setting that names a file: workflows/server/access.py would miss it
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
REMOVED = frozenset(  # now constants in the code
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
        "inverse_rendering.robust",
        "inverse_rendering.open_from",
        "inverse_rendering.open_until",
        "uv.iterations",
        "report.picture_side",
        "report.views_shown",
        "report.masks_shown",
    }
)


def without_old_names(stage: str, values: Mapping[str, Any], names: Collection[str], origin: str) -> dict[str, Any]:
    """The values of a stage by the current names of its settings. names: the current names; none of them is read as an
    old name. If both names are given, the current one wins. origin: where the user wrote them, for the warning."""
    out = {k: _todays_value(f"{stage}.{k}", v, origin) for k, v in values.items() if k in names}
    for name in values.keys() - out.keys():
        path = f"{stage}.{name}"
        if path in RENAMED:
            _hint(
                f"{origin} {path} is now named {stage}.{RENAMED[path]}; the next release will not accept the old name"
            )
            out.setdefault(RENAMED[path], values[name])
        elif path in REMOVED:
            _hint(
                f"{origin} {path} is no longer a setting and was ignored; `neuface settings {stage}` lists the settings"
            )
        else:
            out[name] = values[name]
    return out


def _todays_value(path: str, value: Any, origin: str) -> Any:
    """The current name of a value."""
    new = RENAMED_VALUES.get(path, {}).get(value) if isinstance(value, str) else None
    if new is None:
        return value
    _hint(f"{origin} {path}={value} is now named {path}={new}; the next release will not accept the old name")
    return new


@cache
def _hint(text: str) -> None:
    """Warn once in a process: a run merges its settings more than once."""
    log.warning(text)
