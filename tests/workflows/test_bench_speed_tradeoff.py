"""`neuface bench speed` and `neuface bench tradeoff`: set-ups, growth laws, the front, the plot; fits are not run."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.stats import linregress

from pipeline.errors import UsageError
from stages.inverse_rendering.stage import STAGE
from workflows.bench import speed, tradeoff, tradeoff_measure
from workflows.bench.tradeoff import KNOBS, front
from workflows.bench.tradeoff_measure import Measured
from workflows.bench.tradeoff_plot import plot
from workflows.cli.console import Console
from workflows.cli.main import parser
from workflows.evaluation import demo_material
from workflows.run import host_info


def trade(tmp_path: Path, *more: str) -> Any:
    return parser().parse_args(["bench", "tradeoff", "photos", "--out", str(tmp_path / "out"), *more])


def measured(seconds: float, psnr: float) -> Measured:
    return Measured(seconds, 1000.0, psnr, 0.9, 0.1, 0.5, 25.0)


# ------------------------------------------------------------------ machine
def test_growth_finds_a_power_law() -> None:
    x = [1.0, 2.0, 5.0]
    a, b = host_info.growth(x, [3 * v**1.7 for v in x])
    assert (a, b) == pytest.approx((3, 1.7))
    assert np.isnan(host_info.growth([1, 1], [2, 3])).all() and np.isnan(host_info.growth([1, 2], [0, 3])).all()


def test_the_error_of_a_power_law_is_that_of_its_residuals() -> None:
    """Against scipy's regression of the logarithms; exact points have none, and two points tell none."""
    rng = np.random.default_rng(0)
    x = [1.0, 2.0, 4.0, 8.0, 16.0]
    y = [float(2 * v**0.8 * np.exp(e)) for v, e in zip(x, rng.normal(0, 0.1, 5), strict=True)]
    told = linregress(np.log(x), np.log(y))
    a, b, error = host_info.power_law(x, y)
    assert (a, b, error) == pytest.approx((np.exp(told.intercept), told.slope, told.stderr))
    assert host_info.power_law(x, [3 * v for v in x])[2] == pytest.approx(0, abs=1e-12)
    assert np.isnan(host_info.power_law([1.0, 2.0], [1.0, 2.0])[2])


def test_the_machine_is_told() -> None:
    m = host_info.machine()
    text = host_info.describe(m)
    assert str(m["date"]) in text and str(m["torch"]) in text and f"{m['cores']} cores" in text


def test_seconds_each_is_the_least_after_a_warm_up() -> None:
    calls: list[int] = []
    assert host_info.seconds_each(lambda: calls.append(1), 0.0, 3) < 0.1 and len(calls) == 4


# ------------------------------------------------------------------ speed
def test_every_axis_goes_through_the_middle() -> None:
    setups = speed.setups()
    assert setups[0] == speed.MIDDLE and len(setups) == 7
    for s in setups[1:]:
        assert sum(s[k] != speed.MIDDLE[k] for k in s) == 1


def test_laws_are_exponents_of_single_axes() -> None:
    points = [
        speed.Point(**s, step_ms=2.0 * s["cells"], rays_per_s=1, start_s=0.1 * s["side"] ** 2, memory_mb=s["views"])
        for s in speed.setups()
    ]
    laws = speed.laws(points)
    assert laws["cells"]["step_ms"] == 1.0 and laws["side"]["start_s"] == 2.0 and laws["views"]["memory_mb"] == 1.0
    assert laws["views"]["step_ms"] == 0.0


def test_parts_are_settings_of_the_fit() -> None:
    for part in speed.PARTS.values():
        assert set(part) <= set(speed.WHOLE)
    t = speed.trainer(8, 32, 24, 64, "cpu", speed.PARTS["nothing but albedo and light"])
    t.advance()
    assert not t.model.spec.specular and t.geometry_frozen and t.validation == ()


@pytest.mark.slow
def test_training_of_the_ball_is_timed() -> None:
    p = speed.measure(8, 32, 24, 64, 0.0, "cpu")
    assert p.step_ms > 0 and p.rays_per_s == pytest.approx(64 / (p.step_ms / 1e3), rel=0.02)
    s = speed.harmonics(0.0, "cpu")
    assert s["forward_per_s"] > s["with_gradients_per_s"] > 0
    found = {
        "machine": host_info.machine(),
        "device": "cpu",
        "batch": 64,
        "training": [speed.asdict(p)],
        "growth": speed.laws([p]),
        "parts_ms": {"the whole model": 10.0, "no lobe": 7.5},
        "sh": s,
        "picture_ms": {"field": 1234.5},
    }
    text = "\n".join(speed.report(found))
    assert f"| 8 | 32 | 24 | {p.step_ms} |" in text and "field 1,2" in text
    assert "| no lobe | 7.5 | 25% |" in text


# ------------------------------------------------------------------ tradeoff
def test_every_point_is_a_setting_of_the_stage(tmp_path: Path) -> None:
    given = trade(tmp_path)
    for knob in KNOBS:
        sets = dict(s.split("=", 1) for s in tradeoff_measure.settings_of(knob, given))
        own = {k.split(".", 1)[1]: v for k, v in sets.items() if k.startswith("inverse_rendering.")}
        config = STAGE.config_for(own.get("preset"))(**own)
        for key, value in knob.settings.items():
            assert getattr(config, key) == (round(value * getattr(given, key)) if key in ("steps", "batch") else value)
    assert len({k.name for k in KNOBS}) == len(KNOBS)


def test_the_front_holds_what_nothing_beats() -> None:
    found = {
        "a": measured(10, 30),
        "b": measured(20, 29),
        "c": measured(20, 33),
        "d": measured(40, 33),
        "e": measured(5, 20),
    }
    assert front(found) == ["e", "a", "c"]


def test_a_bench_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def apart(work: Any, knob: Any, given: Any) -> Measured:
        seen.append(knob.name)
        return measured(10 + len(seen), 30 + 0.1 * len(knob.name))

    monkeypatch.setattr(host_info, "apart", apart)
    assert tradeoff.run(trade(tmp_path, "--points", "SH order"), Console()) == 0
    assert tradeoff.run(trade(tmp_path, "--stop-after", "0"), Console()) == 0
    assert seen == ["SH order 2", "SH order 4", "SH order 6"]
    tradeoff.run(trade(tmp_path), Console())
    assert len(seen) == len(KNOBS) == len(set(seen))
    out = tmp_path / "out"
    kept = json.loads((out / "tradeoff.json").read_text())
    assert list(kept["points"]) == [k.name for k in KNOBS] and kept["budget"]["capture"] == "photos"
    text = (out / "tradeoff.md").read_text()
    assert "Two seeds differ by" in text and "**" in text
    tradeoff.run(trade(tmp_path, "--points", "k = 5", "--steps", "7"), Console())
    assert list(json.loads((out / "tradeoff.json").read_text())["points"]) == ["k = 5"]


def test_the_split_has_columns_where_there_is_a_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the demo's capture only; a point without a lobe has no F0 that varies, so no correlation."""
    split = {"f0": 0.5, "f0_error": 0.01, "roughness": 0.25, "roughness_error": 0.05, "light": 0.9}

    def apart(work: Any, knob: Any, given: Any) -> Measured:
        return dataclasses.replace(measured(10, 30), **split) if knob.name == "middle" else measured(20, 31)

    monkeypatch.setattr(host_info, "apart", apart)
    tradeoff.run(trade(tmp_path), Console())
    lines = (tmp_path / "out/tradeoff.md").read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("| point"))
    assert lines[head].count("|") == lines[head + 1].count("|") == 14
    assert lines[head + 2].endswith("| 0.500 | 0.010 | 0.250 | 0.050 | 0.900 |")
    assert lines[head + 3].endswith("| - | - | - | - | - |")


def test_the_split_is_that_of_the_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No figure of a capture that is not the demo's; else those of demo_material.compare, placed by the cameras."""
    assert tradeoff_measure.split_of({}, tmp_path) == {}
    (tmp_path / "demo.json").write_text("{}")
    place = np.diag([2.0, 2.0, 2.0, 1.0])

    def compare(field: Path, folder: Path, capture: Any, where: np.ndarray, out: Path) -> Any:
        assert (field, folder, capture) == (Path("field.npz"), tmp_path, "photos") and out.is_dir()
        assert np.array_equal(where, place)
        f0, roughness = (SimpleNamespace(correlation=c, error=e) for c, e in ((0.5, 0.01), (0.25, 0.05)))
        return SimpleNamespace(f0=f0, roughness=roughness, light_correlation=0.9)

    monkeypatch.setattr(demo_material, "compare", compare)
    fitted = SimpleNamespace(artifact=SimpleNamespace(field="field.npz"), path=Path)
    found = {
        "inverse_rendering": fitted,
        "poses": SimpleNamespace(artifact=SimpleNamespace(capture_from_asset=place.tolist())),
        "capture": SimpleNamespace(artifact="photos"),
    }
    assert tradeoff_measure.split_of(found, tmp_path) == {
        "f0": 0.5,
        "f0_error": 0.01,
        "roughness": 0.25,
        "roughness_error": 0.05,
        "light": 0.9,
    }


def test_without_a_lobe_nothing_correlates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A constant has no correlation: NaN, which JSON does not have."""
    (tmp_path / "demo.json").write_text("{}")
    none = SimpleNamespace(correlation=math.nan, error=0.03)
    figures = SimpleNamespace(f0=none, roughness=none, light_correlation=0.9)
    monkeypatch.setattr(demo_material, "compare", lambda *given: figures)
    fitted = SimpleNamespace(artifact=SimpleNamespace(field="field.npz"), path=Path)
    poses = SimpleNamespace(artifact=SimpleNamespace(capture_from_asset=np.eye(4).tolist()))
    found = {"inverse_rendering": fitted, "poses": poses, "capture": SimpleNamespace(artifact="photos")}
    split = tradeoff_measure.split_of(found, tmp_path)
    assert (split["f0"], split["roughness"], split["f0_error"]) == (None, None, 0.03)


def test_presets_are_points_as_they_are(tmp_path: Path) -> None:
    draft, studio = tradeoff.presets_named("draft, studio")
    assert (draft.preset, studio.preset) == ("draft", "studio")
    assert tradeoff_measure.settings_of(studio, trade(tmp_path)) == ()
    assert tradeoff.presets_named("") == []
    with pytest.raises(UsageError, match="no preset"):
        tradeoff.presets_named("hasty")


def test_an_unknown_point_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no point"):
        tradeoff.run(trade(tmp_path, "--points", "warp drive"), Console())


def test_the_plot_shows_every_point_inside_its_frame() -> None:
    points = {"one & only": (3.0, 28.0), "two": (30.0, 31.5), "three": (31.0, 31.4)}
    root = ElementTree.fromstring(plot(points, ["one & only", "two"]))
    space = "{http://www.w3.org/2000/svg}"
    circles = root.findall(f"{space}circle")
    assert len(circles) == 3 and sum(c.get("class") == "ahead" for c in circles) == 2
    assert all(64 <= float(c.get("cx", 0)) <= 790 and 24 <= float(c.get("cy", 0)) <= 508 for c in circles)
    texts = [t.text for t in root.findall(f"{space}text")]
    assert {"one & only", "two", "1", "1 three"} <= set(texts)
    assert "circle" not in plot({"bad": (1.0, float("nan"))}, [])
