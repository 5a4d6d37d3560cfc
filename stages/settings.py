"""Every setting of every stage: meaning, unit, allowed values, default, and value in each preset.

All of it is read from the stages' configs. `neuface settings` and docs/settings.md show it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from pydantic.fields import FieldInfo

from pipeline.contract import Stage, StageConfig
from pipeline.units import Unit
from stages.presets import PRESETS, configs_for, known

WHERE = "neuface settings"
BOUNDS = (
    ("minimum", "at least"),
    ("exclusiveMinimum", "more than"),
    ("maximum", "at most"),
    ("exclusiveMaximum", "less than"),
)


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting. allowed: its type and limits in words. presets: its value in each preset that has it, by the
    preset's name. only: the values of the stage's setting `preset` that it needs; empty: any."""

    stage: str
    name: str
    meaning: str
    unit: str
    allowed: str
    default: Any
    presets: Mapping[str, Any]
    only: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """The part before the = of --set."""
        return f"{self.stage}.{self.name}"

    def differing(self) -> dict[str, Any]:
        """Presets with another value than the default, and that value."""
        return {preset: value for preset, value in self.presets.items() if value != self.default}

    def record(self) -> dict[str, Any]:
        """The setting as plain values for JSON."""
        return {"key": self.key, **asdict(self)}


def all_settings(registry: Iterable[Stage[Any, Any, Any]] | None = None) -> tuple[Setting, ...]:
    """The settings of all stages, in the order in which the stages run."""
    stages = _registry() if registry is None else tuple(registry)
    filled = {preset: configs_for(preset, {}, registry=stages) for preset in PRESETS}
    return tuple(
        setting
        for stage in stages
        for setting in _settings_of(stage, {preset: configs[stage.name] for preset, configs in filled.items()})
    )


def found(word: str, registry: Iterable[Stage[Any, Any, Any]] | None = None) -> tuple[Setting, ...]:
    """The settings of a stage (masks), one setting (masks.method), or all settings of one name (method).

    Raises:
        UsageError: there is no such stage or setting. The message lists the existing ones and suggests a similar one.
    """
    stages = _registry() if registry is None else tuple(registry)
    settings = all_settings(stages)
    stage, dot, name = word.partition(".")
    same = tuple(s for s in settings if s.name == word)
    if same:
        return same
    known(stage, [s.name for s in stages], what="unknown stage", where=WHERE)
    of_stage = tuple(s for s in settings if s.stage == stage)
    if not dot:
        return of_stage
    known(name, [s.name for s in of_stage], what=f"unknown setting of {stage}", where=WHERE)
    return tuple(s for s in of_stage if s.name == name)


def value_in_words(value: Any) -> str:
    """A value as --set takes it; an empty text as two quotes, because it would be invisible."""
    if isinstance(value, str):
        return value or '""'
    return json.dumps(value)


def _registry() -> tuple[Stage[Any, Any, Any], ...]:
    from stages.registry import EVERY

    return EVERY


def _settings_of(stage: Stage[Any, Any, Any], presets: Mapping[str, StageConfig]) -> Iterator[Setting]:
    """The settings that every preset has, then those that a variant adds or for which it allows other values."""
    for config in stage.configs():
        only = tuple(p for p in stage.variants if stage.config_for(p) is config)
        schemas: dict[str, Any] = config.model_json_schema()["properties"] if config.model_fields else {}
        for name in config.setting_names():
            field: FieldInfo = config.model_fields[name]
            if only and _same(field, stage.config.model_fields.get(name)):
                continue
            values = {p: getattr(c, name) for p, c in presets.items() if isinstance(c, config)}
            unit = next((m.name for m in field.metadata if isinstance(m, Unit)), "")
            allowed = _allowed(schemas[name])
            yield Setting(stage.name, name, field.description or "", unit, allowed, field.default, values, only)


def _same(field: FieldInfo, other: FieldInfo | None) -> bool:
    """Whether two classes declare a setting alike, by inheritance."""
    return other is not None and (field.annotation, field.description) == (other.annotation, other.description)


def _allowed(schema: Mapping[str, Any]) -> str:
    """Type and limits of a JSON schema, as text."""
    if "anyOf" in schema:
        return ", or ".join(_allowed(part) for part in schema["anyOf"])
    if "enum" in schema or "const" in schema:
        return _either([value_in_words(v) for v in schema.get("enum", [schema.get("const")])])
    kind = schema["type"]
    if kind == "array":
        return f"{len(schema['prefixItems'])} numbers in brackets"
    if kind == "string":
        return f"text of up to {schema['maxLength']} characters" if "maxLength" in schema else "text"
    return {"boolean": "true or false", "integer": "whole number", "number": "number"}[kind] + _limits(schema)


def _either(words: list[str]) -> str:
    return ", ".join(words[:-1]) + " or " + words[-1] if len(words) > 1 else words[0]


def _limits(schema: Mapping[str, Any]) -> str:
    """The limits of a number, as text that follows its type."""
    if "minimum" in schema and "maximum" in schema:
        text = f", {_number(schema['minimum'])} to {_number(schema['maximum'])}"
    else:
        text = "".join(f", {words} {_number(schema[bound])}" for bound, words in BOUNDS if bound in schema)
    return text + (f", a multiple of {_number(schema['multipleOf'])}" if "multipleOf" in schema else "")


def _number(value: float) -> str:
    return str(int(value)) if float(value).is_integer() else str(value)
