"""`neuface settings`: every setting, those of a stage, or one."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from itertools import groupby

from stages.settings import Setting, all_settings, found, value_in_words
from workflows.cli.console import Console


def add_options(settings: argparse.ArgumentParser) -> None:
    """Its options."""
    settings.add_argument(
        "name", nargs="?", metavar="STAGE[.NAME]", help="a stage (masks) or one setting (inverse_rendering.batch)"
    )
    settings.add_argument("--json", action="store_true", help="as JSON: a list with one record for each setting")
    settings.set_defaults(run=settings_command)


def settings_command(options: argparse.Namespace, console: Console) -> int:
    """neuface settings"""
    chosen = found(options.name) if options.name else all_settings()
    if options.json:
        print(json.dumps([s.record() for s in chosen], indent=1))
    elif options.name and len(chosen) == 1:
        print("\n".join(explained(chosen[0])))
    else:
        print("\n".join(listed(chosen)) or f"{options.name} has no settings")
    return 0


def listed(settings: Sequence[Setting]) -> Iterator[str]:
    """Two lines for each setting, under the name of its stage: what it is set to and may be, and what it means."""
    for (stage, only), own in groupby(settings, lambda s: (s.stage, s.only)):
        yield f"{stage}" + (f", only with {stage}.preset = {' or '.join(only)}" if only else "")
        for s in own:
            presets = "".join(f"; {name} {value_in_words(v)}" for name, v in s.differing().items())
            yield f"  {s.name} = {_with_unit(s)}   ({s.allowed}{presets})"
            yield f"      {s.meaning}"


def explained(s: Setting) -> Iterator[str]:
    """All that is known of one setting."""
    yield f"{s.key}: {s.meaning}"
    rows = {"unit": s.unit or "none", "allowed": s.allowed, "default": value_in_words(s.default)}
    rows |= {f"preset {name}": value_in_words(value) for name, value in s.presets.items()}
    width = max(map(len, rows))
    for what, text in rows.items():
        yield f"  {what:{width}}  {text}"
    if s.only:
        yield f"  only with {s.stage}.preset = {' or '.join(s.only)}"
    yield f"  set it with --set {s.key}=VALUE, or under [{s.stage}] in a --config file"


def _with_unit(s: Setting) -> str:
    return f"{value_in_words(s.default)} {s.unit}".strip()
