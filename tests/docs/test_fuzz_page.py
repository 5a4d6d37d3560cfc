"""docs/benchmarks/fuzz.md is what its JSON says, and no row of it failed."""

from __future__ import annotations

import base64
from xml.etree import ElementTree

import pytest

from benchmarks import fuzz_counts
from benchmarks.fuzz_counts import Row, functions, rows_of


def test_the_page_is_made_of_its_record_and_has_no_fault() -> None:
    """Made by: python -m benchmarks.fuzz_counts --write"""
    assert fuzz_counts.PAGE.read_text() == fuzz_counts.page()
    assert not any(r.failed for r in fuzz_counts.recorded().values())


def test_every_fuzz_test_is_found() -> None:
    found = functions()
    assert len(found) == len(set(found)) >= 20
    assert "tests/fuzz/test_fuzz_cameras.py::test_damaged_bytes" in found
    assert not any("bomb" in f or "deep" in f for f in found)  # those have no random cases


def test_a_test_that_never_ran_is_named_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz_counts, "functions", lambda: ["tests/fuzz/test_fuzz_x.py::test_new"])
    assert "cases yet: `test_new`" in fuzz_counts.page() and "0 cases in 0 tests" in fuzz_counts.page()


def test_rows_come_from_pytests_file_with_hypothesis_counts() -> None:
    said = (
        "  - during reuse phase:\n    - 1 passing, 0 failing\n  - during generate phase:\n    - 98 passing, 1 failing"
    )
    name = "tests/fuzz/test_fuzz_x.py::test_a[kind]"
    junit = ElementTree.fromstring(f"""<testsuites><testsuite><properties><property
        name="hypothesis-statistics-{name}" value="{base64.b64encode(said.encode()).decode()}"/></properties>
        <testcase classname="tests.fuzz.test_fuzz_x" name="test_a[kind]" time="2.54"><properties>
        <property name="read" value="60"/><property name="refused" value="39"/></properties><failure/></testcase>
        </testsuite></testsuites>""")
    assert dict(rows_of(junit, "2026-01-01", "abc")) == {name: Row(100, 60, 39, 2.5, True, "2026-01-01", "abc")}
