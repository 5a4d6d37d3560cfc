"""Tables of measurements in README.md and docs that no other script makes, from docs/benchmarks/history.json.

    python -m benchmarks.history            # prints the tables
    python -m benchmarks.history --write    # puts them into their pages

`<!-- table: NAME -->` in the line before a table names its record. To change a table, change its record, and write.
`commit` and `date` say when its numbers came into the page: of several rows, the newest one.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from benchmarks.record_ages import FOLDER, ROOT

RECORD = FOLDER / "history.json"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/stages").glob("*.md")))
PLACE = re.compile(r"(?:^(?P<indent> *)<!-- table: (?P<name>[\w-]+) -->\n)?(?P<lines>(?:^ *\|.*\n)+)", re.M)
BAR = re.compile(r"(?<!\\)\|")  # a bar in a cell is written \|
NUMBER = re.compile(r"[-+*~<>]*\.?\d")


@dataclass(frozen=True)
class Table:
    """A record. kind: "kept" or "current".

    kept: a result of what was tried and is not in the code any more, or one that newer figures have replaced. Its age
    does not matter. newer: the record of the newer figures, if they have one.
    current: what the code does now. benchmarks.record_ages checks its age against the changes of `code`.
    command: "" if the page has none, which only a kept one may.
    """

    page: str
    kind: str
    commit: str
    date: str
    command: str
    code: list[str]
    header: list[str]
    rows: list[list[str]]
    newer: str = ""

    def lines(self) -> list[str]:
        """The table as it stands on its page."""
        return [line(self.header), "|" + "---|" * len(self.header), *map(line, self.rows)]


@dataclass(frozen=True)
class Found:
    """A table on a page. name: "" if it has no mark."""

    name: str
    lines: list[str]

    def has_figures(self) -> bool:
        """Whether at least half of the cells of some column begin with a number."""
        columns = zip(*map(cells, self.lines[2:]), strict=True)
        return any(2 * sum(bool(NUMBER.match(cell)) for cell in column) >= len(column) for column in columns)


def line(row: Sequence[str]) -> str:
    """A row of a table; an empty cell is one space."""
    return "|" + "".join(f" {cell} |" if cell else " |" for cell in row)


def cells(row: str) -> list[str]:
    """The cells of a row."""
    return [cell.strip() for cell in BAR.split(row)[1:-1]]


def recorded() -> dict[str, Table]:
    """The records by name."""
    return {name: Table(**content) for name, content in json.loads(RECORD.read_text()).items()}


def found(text: str) -> Iterator[Found]:
    """Every table of a page."""
    for place in PLACE.finditer(text):
        yield Found(place["name"] or "", [one.strip() for one in place["lines"].splitlines()])


def filled(text: str, tables: dict[str, Table]) -> str:
    """The page with the tables of the records at their marks."""

    def put(place: re.Match[str]) -> str:
        if place["name"] is None:
            return place[0]
        lines = [f"<!-- table: {place['name']} -->", *tables[place["name"]].lines()]
        return "".join(f"{place['indent']}{one}\n" for one in lines)

    return PLACE.sub(put, text)


def main(arguments: Sequence[str]) -> int:
    """Prints the tables, or writes them into their pages."""
    tables = recorded()
    if "--write" not in arguments:
        for name, table in tables.items():
            print("\n".join([f"{table.page}: {name}", *table.lines(), ""]))
        return 0
    for page in PAGES:
        text = page.read_text()
        if (made := filled(text, tables)) != text:
            page.write_text(made)
            print(page.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
