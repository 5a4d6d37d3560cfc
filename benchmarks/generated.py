"""Parts of documents that are made from the code: printed, or written between their two marks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def print_or_write(arguments: Sequence[str], page: Path, part: str) -> int:
    """--write puts `part`, whose first and last line are the marks, into the page; else it is printed."""
    if "--write" not in arguments:
        print(part)
        return 0
    begin, end = part.splitlines()[0], part.splitlines()[-1]
    text = page.read_text()
    before, rest = text.split(begin)
    page.write_text(before + part + rest.split(end)[1])
    return 0
