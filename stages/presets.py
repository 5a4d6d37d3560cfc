"""Merges the settings of every stage from a preset, a settings file and --set. This is the only place that does so.

Order, the later one wins: the defaults of the stages, the preset, the settings that a time budget chose, the options
of several stages (holdout, name, seed), the settings file, --set.
"""

from __future__ import annotations

import difflib
import json
import reprlib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.contract import Stage, StageConfig
from pipeline.errors import UsageError
from stages.old_names import without_old_names

Settings = Mapping[str, Mapping[str, Any]]

# Speed against accuracy, measured in docs/benchmarks.md. draft, the default: minutes; studio: a quarter of an hour on a
# CPU; film: an hour, or a GPU.
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {
        "inverse_rendering": {"preset": "draft"},
        "surface": {"resolution": 512},
        "uv": {"target_faces": 50_000},
        "bake": {"size": 1024, "beside": 2},
        "usd": {"high_faces": 200_000},
    },
    "studio": {
        "inverse_rendering": {"preset": "studio"},
        "surface": {"resolution": 640},
        "uv": {"target_faces": 60_000},
        "bake": {"size": 2048},
    },
    "film": {
        "inverse_rendering": {"preset": "film"},
        "surface": {"resolution": 896},
        "uv": {"target_faces": 100_000},
        "bake": {"size": 4096},
    },
    # Not part of that scale: the paper's own model and schedule, for comparison (docs/model.md). For a GPU.
    "paper": {
        "inverse_rendering": {"preset": "paper"},
        "surface": {"resolution": 640},
        "uv": {"target_faces": 60_000},
        "bake": {"size": 2048},
    },
}
DEFAULT_PRESET = "draft"
MAX_BYTES = 1_000_000  # of a settings file


def configs_for(
    preset: str,
    sets: Settings,
    config_file: Settings | None = None,
    *,
    holdout: str | None = None,
    name: str | None = None,
    seed: int | None = None,
    template: str | None = None,
    light: str | None = None,
    registry: Iterable[Stage[Any, Any, Any]] | None = None,
    planned: Settings | None = None,
) -> dict[str, StageConfig]:
    """The validated settings of every stage, by the stage's name. planned: settings chosen for a time budget; they
    override the preset. template: folder of another head template, from which the asset is made. light: file of the
    photos' light, which is then not estimated.

    Raises:
        UsageError: unknown preset, stage or setting, or a value outside its limits. The message lists what is allowed.
    """
    stages = {s.name: s for s in (_registry() if registry is None else registry)}
    known(preset, PRESETS, what="unknown preset", where="--preset")
    merged: dict[str, dict[str, Any]] = {n: {} for n in stages}
    of_stage = {s: _last(s, "preset", (PRESETS[preset], planned or {}, config_file or {}, sets)) for s in stages}
    classes = {name: stage.config_for(of_stage[name]) for name, stage in stages.items()}
    shared = (_shared(stages, holdout, name, seed), _of_template(template), _of_light(light))
    for source in (PRESETS[preset], planned or {}, *shared):
        for stage, own in source.items():
            if stage in merged:
                merged[stage].update(own)
    for origin, settings in (("--config", config_file or {}), ("--set", sets)):
        for stage, values in settings.items():
            known(stage, stages, what="unknown stage", where=f"{origin} {stage}")
            if not isinstance(values, Mapping):
                raise UsageError(
                    "the settings of a stage must be a table",
                    where=f"{origin} {stage}",
                    value=repr(values),
                    limit="key = value under the stage's name",
                    remedy=f"write [{stage}] above its keys",
                )
            names = classes[stage].setting_names()
            current = without_old_names(stage, values, names, origin)
            for key in current:
                _not_of_a_variant(stages[stage], key, names, origin)
                known(key, names, what=f"unknown setting of {stage}", where=f"{origin} {stage}.{key}")
            merged[stage].update(current)
    _tile_size(merged)
    _template(merged, classes)
    return {name: _checked(name, classes[name], values) for name, values in merged.items()}


def _last(stage: str, key: str, sources: Iterable[Settings]) -> object:
    """The value that the last of the sources gives to a setting; None if none does."""
    tables = [source.get(stage) for source in sources]
    return next((t[key] for t in reversed(tables) if isinstance(t, Mapping) and key in t), None)


def _not_of_a_variant(stage: Stage[Any, Any, Any], key: str, names: Iterable[str], origin: str) -> None:
    """Raise a UsageError if only a preset that is not selected has this setting. The message names the preset."""
    presets = (
        [p for p, variant in stage.variants.items() if key in variant().setting_names()] if key not in names else []
    )
    if presets:
        raise UsageError(
            f"a setting of {stage.name} that only other presets have",
            where=f"{origin} {stage.name}.{key}",
            value=key,
            limit=f"with {stage.name}.preset = {' or '.join(presets)}",
            remedy=f"add --set {stage.name}.preset={presets[0]}, or leave {stage.name}.{key} out",
        )


def _tile_size(merged: dict[str, dict[str, Any]]) -> None:
    """The number of UDIM tiles is computed for bake.size, unless uv.tile_size is set."""
    uv, bake = merged.get("uv", {}), merged.get("bake", {})
    if uv.get("tiles") == "auto" and "tile_size" not in uv and "size" in bake:
        uv["tile_size"] = bake["size"]


def _template(merged: dict[str, dict[str, Any]], classes: Mapping[str, type[StageConfig]]) -> None:
    """The head template is registered only where the asset may be made from it, or where that is asked for."""
    field = classes["uv"].model_fields.get("mesh") if "uv" in classes else None
    if field is None or "template" not in merged:
        return
    mesh, template = merged["uv"].get("mesh", field.default), merged["template"]
    if mesh != "scan":
        template.setdefault("enabled", True)
        template.setdefault("faultless", mesh == "auto")


def _of_template(folder: str | None) -> Settings:
    """The settings that another head template means."""
    if folder is None:
        return {}
    return {"template": {"folder": str(Path(folder).absolute())}, "uv": {"mesh": "template"}}


def _of_light(path: str | None) -> Settings:
    """The settings that a given light means."""
    return {} if path is None else {"inverse_rendering": {"light_file": str(Path(path).absolute())}}


def _registry() -> tuple[Stage[Any, Any, Any], ...]:
    from stages.registry import REGISTRY

    return REGISTRY


def _shared(
    stages: Mapping[str, Stage[Any, Any, Any]], holdout: str | None, name: str | None, seed: int | None
) -> dict[str, dict[str, Any]]:
    """Options that apply to every stage with a setting of that name."""
    given = {"holdout": holdout, "name": name, "seed": seed}
    found: dict[str, dict[str, Any]] = {}
    for stage in stages.values():
        for key, value in given.items():
            if value is not None and key in stage.config.model_fields:
                found.setdefault(stage.name, {})[key] = value
    return found


def _checked(name: str, config: type[StageConfig], values: Mapping[str, Any]) -> StageConfig:
    try:
        return config(**values)
    except ValidationError as e:
        first = e.errors()[0]
        key = ".".join(str(part) for part in (name, *first["loc"]))
        field = config.model_fields.get(str(first["loc"][0])) if first["loc"] else None
        about = f" ({field.description})" if field and field.description else ""
        raise UsageError(
            "a setting is outside its limits",
            where=key,
            value=reprlib.repr(first["input"]),
            limit=first["msg"],
            remedy=f"change {key}{about}",
        ) from e


def known(word: str, choices: Iterable[str], *, what: str, where: str) -> None:
    """Raise a UsageError if `word` is not one of `choices`. The message lists them and suggests a similar one."""
    listed = list(choices)
    if word in listed:
        return
    near = difflib.get_close_matches(word, listed, n=1)
    guess = f"did you mean {near[0]}?" if near else "use one of these names"
    raise UsageError(what, where=where, value=word, limit="one of: " + ", ".join(listed), remedy=guess)


# ------------------------------------------------------------------ what users write
def parse_sets(pairs: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Parse `stage.key=value`. A value in brackets, or null, is read as JSON; any other by the setting's own type."""
    found: dict[str, dict[str, Any]] = {}
    for pair in pairs:
        path, equals, text = pair.partition("=")
        stage, dot, key = path.strip().partition(".")
        if not (equals and dot and stage and key):
            raise UsageError(
                "a --set option can't be parsed",
                where="--set",
                value=pair,
                limit="stage.key=value",
                remedy="for example --set bake.size=2048",
            )
        found.setdefault(stage, {})[key] = _value(text.strip())
    return found


def _value(text: str) -> Any:
    if text == "null" or text[:1] in ("[", "{"):
        try:
            return json.loads(text)
        except (ValueError, RecursionError):
            return text
    return text


def read_config_file(path: Path) -> dict[str, dict[str, Any]]:
    """Read settings from a .toml or .json file: one table for each stage.

    Raises:
        UsageError: the file is missing, has another format, or can't be parsed.
    """
    kinds = {".toml": tomllib.loads, ".json": json.loads}
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError(f"more than {MAX_BYTES // 1000} kB")
        read: Any = kinds[path.suffix.lower()](path.read_text(encoding="utf-8"))
    except KeyError:
        fault = f"a {path.suffix or 'nameless'} file"
    except RecursionError:
        fault = "tables are nested too deeply"
    except (OSError, ValueError) as e:
        fault = str(e)[:200]
    else:
        stray = [k for k, v in read.items() if not isinstance(v, dict)] if isinstance(read, dict) else []
        if isinstance(read, dict) and not stray:
            return read
        fault = f"{reprlib.repr(stray[0])} outside of any table" if stray else f"a {type(read).__name__} at the top"
    raise UsageError(
        "the settings file can't be read",
        where=f"--config {path}",
        value=fault,
        limit="a .toml or .json file with one table for each stage",
        remedy="for example a file s.toml that holds [bake] and under it size = 2048",
    )
