"""`neuface bench ablations`: rows, tables and what they say; the fits themselves are tested with the stage."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import UsageError
from stages.inverse_rendering.stage import STAGE
from workflows.bench import ablations as bench
from workflows.bench.ablations import FULL, TABLES, Result, Row, ordering, report, settings_of, unique
from workflows.cli.console import Console
from workflows.cli.main import parser

BUDGET = {"steps": 3, "side": 64, "batch": 32, "holdout": "every:5:2", "capture": "ball"}


def options(tmp_path: Path, *more: str) -> Any:
    return parser().parse_args(["bench", "ablations", "photos", "--out", str(tmp_path / "out"), *more])


def test_every_row_is_a_setting_of_the_stage(tmp_path: Path) -> None:
    for row in unique(TABLES):
        sets = dict(s.split("=", 1) for s in settings_of(row, options(tmp_path)))
        own = {k.split(".", 1)[1]: v for k, v in sets.items() if k.startswith("inverse_rendering.")}
        config = STAGE.config_for(own.get("preset"))(**own)
        for key, value in row.settings.items():
            assert getattr(config, key) == value, (row.name, key)


def test_the_papers_tables_are_all_there() -> None:
    titles = " ".join(t.title for t in TABLES)
    assert all(name in titles for name in ("Table 2", "Table 3", "Table A2", "Fig. A3"))
    assert [len(t.rows) for t in TABLES[:4]] == [4, 3, 4, 8]
    assert all(FULL in t.rows for t in TABLES)
    assert sorted(r.settings.get("rank", 3) for r in TABLES[3].rows) == list(range(1, 9))


def result(psnr: float) -> Result:
    return Result(psnr, psnr + 1, 0.9, 0.1, 0.5, 10.0)


def test_ordering_counts_pairs() -> None:
    rows = [Row("a", {}, (30.0, 0.4)), Row("b", {}, (29.0, 0.5)), Row("c", {}, (28.0, 0.6)), Row("d")]
    found = ordering(rows, {"a": result(20), "b": result(25), "c": result(10), "d": result(5)})
    assert found == "Found: b > a > c > d. Agrees with the paper's order in 2 of 3 pairs."


def test_report_shows_what_there_is() -> None:
    text = "\n".join(report(BUDGET, {FULL.name: result(31), "SH + Phong": result(30)}))
    assert "3 steps of 32 rays, photos of 64 px, capture ball" in text
    assert "| SH + Phong | 30.00 | 31.00 | 0.9000 | 0.1000 | 0.500 | 10 | 29.31, 0.556 |" in text
    assert "Agrees with the paper's order in 1 of 1 pairs." in text and "direct fitting" not in text
    assert "Two seeds" not in text
    noisy = "\n".join(report(BUDGET, {FULL.name: result(31), "another seed": result(30.75)}))
    assert "Two seeds of the same system differ by 0.25 dB" in noisy


def test_a_bench_goes_on_and_a_changed_budget_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def measure(row: Row, given: Any, console: Any) -> Result:
        seen.append(row.name)
        return result(30 + len(row.name) / 100)

    monkeypatch.setattr(bench, "measure", measure)
    assert bench.run(options(tmp_path, "--rows", "k = 1"), Console()) == 0
    assert bench.run(options(tmp_path, "--rows", "k = 2"), Console()) == 0
    path = tmp_path / "out" / "ablations.json"
    assert set(json.loads(path.read_text())["rows"]) == {"k = 1", "k = 2"} and seen == ["k = 1", "k = 2"]
    bench.run(options(tmp_path, "--rows", "k = 4", "--steps", "7"), Console())
    assert set(json.loads(path.read_text())["rows"]) == {"k = 4"}
    assert "7 steps" in (tmp_path / "out" / "ablations.md").read_text()


def test_an_unknown_row_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no row"):
        bench.run(options(tmp_path, "--rows", "nobody"), Console())


def test_aligned_psnr_forgives_one_matrix_and_no_more() -> None:
    rng = np.random.default_rng(0)
    photo = rng.uniform(0.05, 0.5, (20, 20, 3)).astype(np.float32)
    from pipeline.colour import linear_from_srgb, srgb_from_linear

    mixed = linear_from_srgb(
        srgb_from_linear(photo) @ np.array([[0.9, 0.05, 0], [0, 1, 0.02], [0.1, 0, 0.8]], np.float32)
    )
    mask = np.ones((20, 20), np.float32)
    assert bench.aligned_psnr(np.asarray(mixed, np.float32), photo, mask) > 60
    assert bench.aligned_psnr(photo[::-1].copy(), photo, mask) < 20
