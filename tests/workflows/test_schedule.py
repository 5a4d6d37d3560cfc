"""The farm on paper, against what can be worked out by hand and against bounds that hold for any schedule."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workflows.batch.schedule import Farm, Load, load_of, simulate
from workflows.cli.main import main


def test_one_worker_is_the_sum() -> None:
    f = simulate(Load(10, 60, 30, read=100, written=200), 7, Farm(1, 1, link=10))
    assert f.hours * 3600 == pytest.approx(7 * (10 + 60 + 30 + 10 + 20))
    assert f.busy["GPU"] == pytest.approx(60 / 130)


def test_two_workers_overlap_cpu_with_the_fit() -> None:
    """CPU 40, fit 60, one GPU: after the first 40 s the GPU never rests."""
    f = simulate(Load(40, 60, 0), 10, Farm(1, 2))
    assert f.hours * 3600 == pytest.approx(40 + 10 * 60)
    assert f.bottleneck == "GPU"


def test_a_narrow_link_is_named() -> None:
    f = simulate(Load(1, 1, 1, read=100), 50, Farm(8, 16, link=10))
    assert f.bottleneck == "link"
    assert f.hours * 3600 == pytest.approx(50 * 10 + 3)


@given(
    st.floats(0, 50), st.floats(1, 50), st.floats(0, 50), st.floats(0, 50), st.integers(1, 40), st.integers(1, 6),
    st.integers(1, 4),
)  # fmt: skip
@settings(max_examples=60)
def test_bounds_of_any_schedule(
    before: float, fit: float, after: float, read: float, captures: int, gpus: int, each: int
) -> None:
    load, farm = Load(before, fit, after, read=read), Farm(gpus, gpus * each, link=1)
    seconds = simulate(load, captures, farm).hours * 3600
    whole = before + fit + after + read
    least = max(whole, captures * fit / gpus, captures * read, captures * whole / farm.workers)
    assert least - 1e-6 <= seconds <= captures * whole + 1e-6


def test_spread_and_losses_cost_what_they_must_on_average() -> None:
    """One worker: the mean of a log-normal factor of mean 1 is 1; a loss of share p repeats p / (1 - p) halves."""
    load, n, p = Load(0, 10, 0), 4000, 0.2
    spread = simulate(load, n, Farm(1, 1, spread=0.5)).hours * 3600 / n
    assert spread == pytest.approx(10, rel=0.03)
    lost = simulate(load, n, Farm(1, 1, lost=p)).hours * 3600 / n
    assert lost == pytest.approx(10 * (1 + p / (1 - p) / 2), rel=0.02)


def test_same_seed_same_answer_and_no_captures_no_time() -> None:
    farm = Farm(2, 4, 5.0, 0.3, 0.1)
    assert simulate(Load(1, 2, 3, 4, 5), 30, farm) == simulate(Load(1, 2, 3, 4, 5), 30, farm)
    assert simulate(Load(1, 2, 3), 0, farm).hours == 0


def test_from_a_measured_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = tmp_path / ".store"
    stages = {"capture": 1.0, "masks": 9.0, "inverse_rendering": 100.0, "bake": 20.0, "report": 5.0}
    for name in stages:
        (store / name / "k").mkdir(parents=True)
        (store / name / "k/x").write_bytes(bytes(1000))
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset/a.usd").write_bytes(bytes(500))
    record = {"stages": {n: {"seconds": s, "key": "k"} for n, s in stages.items()}, "store": str(store)}
    (tmp_path / "run.json").write_text(json.dumps(record))
    assert load_of([tmp_path]) == Load(10, 100, 25, read=1000, written=5500, kept=5500)
    assert main(["schedule", str(tmp_path), "--captures", "100", "--gpus", "1,8", "--gpu-hour", "2"]) == 0
    said = capsys.readouterr().out
    assert said.count("bottleneck: GPU") == 2
    assert main(["schedule", str(store)]) == 1
