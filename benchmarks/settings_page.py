"""The tables of docs/settings.md, from the stages' configs: the same source as `neuface settings`.

    python -m benchmarks.settings_page            # prints them
    python -m benchmarks.settings_page --write    # puts them into docs/settings.md

tests/docs holds the page to it.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path

from benchmarks.generated import print_or_write
from stages.registry import EVERY
from stages.settings import Setting, all_settings, value_in_words

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"
BEGIN, END = "<!-- settings -->", "<!-- /settings -->"
HEAD = "| setting | default | may be | presets | meaning |\n|---|---|---|---|---|"


def tables() -> str:
    """A table for each stage, between the page's marks."""
    return "\n".join([BEGIN, *_lines(), END])


def row(s: Setting) -> str:
    """A line of a table."""
    unit = f" {s.unit}" if s.unit else ""
    presets = ", ".join(f"{name} {value_in_words(v)}" for name, v in s.differing().items())
    cells = (f"`{s.name}`", f"{value_in_words(s.default)}{unit}", s.allowed, presets, s.meaning)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _lines() -> Iterator[str]:
    settings = all_settings()
    for stage in EVERY:
        for config in stage.configs():
            only = tuple(p for p in stage.variants if stage.config_for(p) is config)
            title = f"### {stage.name}, preset {' or '.join(only)}" if only else f"## {stage.name}"
            yield f"\n{title}\n{inspect.cleandoc(config.__doc__ or '')}\n"
            own = [s for s in settings if (s.stage, s.only) == (stage.name, only)]
            if own:
                yield "\n".join([HEAD, *map(row, own)])


if __name__ == "__main__":
    sys.exit(print_or_write(sys.argv[1:], PAGE, tables()))
