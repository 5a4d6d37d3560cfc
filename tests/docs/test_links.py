"""Links between the documents lead somewhere, and docs/index.md lists every page."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
GENERATED = {"settings.md"}  # made by a script of its own


def test_every_link_leads_to_a_file() -> None:
    for page in PAGES:
        for link in LINK.findall(page.read_text()):
            if not link.startswith(("http:", "https:", "mailto:")) and Path(link).name not in GENERATED:
                assert (page.parent / link).exists(), f"{page.relative_to(ROOT)}: {link}"


def test_the_index_lists_every_page() -> None:
    docs = ROOT / "docs"
    linked = set(LINK.findall((docs / "index.md").read_text()))
    there = {p.relative_to(docs).as_posix() for p in docs.rglob("*.md")} - {"index.md"}
    assert there - linked == set()


def test_pictures_of_the_guide_are_small() -> None:
    found = list((ROOT / "docs/pictures/photographing").glob("*"))
    assert len(found) == 4 and all(p.suffix == ".jpg" and p.stat().st_size < 100_000 for p in found)
    text = (ROOT / "docs/photographing.md").read_text()
    assert all(f"pictures/photographing/{p.name}" in text for p in found)
