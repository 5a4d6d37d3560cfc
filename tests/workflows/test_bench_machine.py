"""`neuface bench machine`: the rates' work is what it says, floors are rooflines, and counts are those of the run."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from pipeline.errors import StageError, UsageError
from pipeline.fields.appearance import mlp
from stages.registry import REGISTRY
from workflows.bench import floors, machine, machine_kernels, machine_rates
from workflows.bench.floor_counts import Counts, counts_of, sizes
from workflows.bench.floors import STAGES, Work
from workflows.bench.machine_rates import Rates
from workflows.cli.console import Console
from workflows.cli.main import parser

EACH = Rates(**{f.name: 1.0 for f in dataclasses.fields(Rates)})
SECONDS = {s.name: 10.0 for s in REGISTRY if s.name in STAGES}
SIZE = 512


def file(path: str, size: int = 100) -> dict[str, Any]:
    return {"path": path, "sha256": "0" * 64, "size": size}


def manifests(photos: int = 10, kind: str = "jpg", source: str = "key") -> dict[str, dict[str, Any]]:
    """Of a small run: `photos` photos of SIZE pixels, every fifth held out."""
    held = [n for n in range(photos) if n % 5 == 2]
    views = [
        {"index": n, "image": file(f"photos/{n}.{kind}", 1000), "width": SIZE, "height": SIZE, "holdout": n in held}
        for n in range(photos)
    ]
    fit = {
        "field": file("field.npz", 5000),
        "light_order": 6,
        "rank": 2,
        "fitted_views": [n for n in range(photos) if n not in held],
        "model": {"stereo": {"why": "correlation of the small photos on validation views"}},
    }
    maps = {
        "albedo": {"channels": 3, "files": {"exr": file("a.exr"), "png": file("a.png")}},
        "f0": {"channels": 1, "files": {"exr": file("f.exr")}},
    }
    return {
        "capture": {"views": views},
        "poses": {"source": "given", "cameras": []},
        "masks": {"masks": [{"source": source, "coverage": 0.25, "mask": file(f"{n}.png", 50)} for n in range(photos)]},
        "inverse_rendering": fit,
        "surface": {"mesh": file("surface.npz", 7000), "faces": 30_000, "cell": 0.002},
        "uv": {"mesh": file("uv.npz"), "of_template": False, "faces": 5000, "utilisation": 0.5},
        "bake": {"size": 256, "tiles": 1, "sides": [], "maps": maps},
    }


def settings() -> dict[str, dict[str, Any]]:
    """Defaults of every stage."""
    return {s.name: s.config().model_dump(mode="json") for s in REGISTRY}


def write_run(folder: Path, made: dict[str, dict[str, Any]], seconds: float = 3.0) -> Path:
    """A run's folder with its store."""
    stages = {}
    for name, manifest in made.items():
        place = folder / "store" / name / "k"
        place.mkdir(parents=True)
        (place / "manifest.json").write_text(json.dumps(manifest))
        (place / "run.json").write_text(json.dumps({"config": settings()[name]}))
        stages[name] = {"key": "k", "seconds": seconds}
    out = folder / "out"
    out.mkdir()
    (out / "run.json").write_text(json.dumps({"stages": stages, "store": str(folder / "store")}))
    return out


@pytest.fixture
def counts(tmp_path: Path) -> Counts:
    return counts_of(write_run(tmp_path, manifests()))


def without_disk(work: Work) -> dict[str, float]:
    return {k: v for k, v in dataclasses.asdict(work).items() if k not in ("write", "hashed")}


# ------------------------------------------------------------------ the rates' work
def test_samples_are_bilinear_samples() -> None:
    picture = np.random.default_rng(1).random((20, 20), np.float32)
    out = np.zeros(3, np.float32)
    machine_kernels.samples(picture, 1000, out)
    for task, found in enumerate(out):
        n = np.arange(1, 1001)
        x = (task + n * (0.618 + 0.001 * task)) % 18
        y = (0.5 * task + n * (0.382 + 0.001 * task)) % 18
        assert found == pytest.approx(0.5 * map_coordinates(picture, [y, x], order=1).sum(), rel=1e-3)


def test_polynomials_are_horner_s() -> None:
    x = np.random.default_rng(2).random((2, 64), np.float32)
    out = np.zeros_like(x)
    machine_kernels.polynomials(x, out, 3)
    a = 0.5 + 0.001 * 2  # the last turn's
    assert out == pytest.approx(np.polyval([0.25] + [a] * machine_kernels.DEGREE, x.astype(np.float64)), rel=1e-5)


def test_the_ball_is_closed_and_round() -> None:
    vertices, faces = machine_rates.ball(60)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert len(faces) == 2 * 60**2
    assert 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() == pytest.approx(4 * math.pi, rel=0.01)
    assert np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6 == pytest.approx(4 / 3 * math.pi, rel=0.01)


def test_a_rate_is_the_median(monkeypatch: pytest.MonkeyPatch) -> None:
    """One slow call of five, and the first one, which warms up, do not count. Processor time counts for each core."""
    times = [0.0, 2.0, 2.0, 4.0, 4.0, 54.0, 54.0, 56.0, 56.0, 57.0]
    calls: list[int] = []
    for clock, of, cores in (("perf_counter", machine_rates.wall_rate, 1), ("process_time", machine_rates.rate, 3)):
        left = iter(times)
        monkeypatch.setattr(machine_rates.time, clock, lambda left=left: next(left))
        monkeypatch.setattr(machine_rates, "_cores", lambda: 3)
        assert of(8.0, lambda: calls.append(1)) == 4.0 * cores
    assert len(calls) == 12


def test_waiting_is_no_work_of_the_processor() -> None:
    assert machine_rates.rate(1.0, lambda: time.sleep(0.05)) > 5 * machine_rates.wall_rate(
        1.0, lambda: time.sleep(0.05)
    )


@pytest.mark.slow
def test_a_machine_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"REPEATS": 1, "MATRIX": 64, "COPIED": 1 << 20, "FILE": 1 << 20, "PICTURE": 64, "RAYS": 9000,
                        "SAMPLES": 100, "ROUNDS": 1, "BALL": 20}.items():  # fmt: skip
        monkeypatch.setattr(machine_rates, name, value)
    found = dataclasses.asdict(machine_rates.measured(tmp_path))
    assert all(v > 0 and math.isfinite(v) for v in found.values()) and found.keys() == machine.SHOWN.keys()
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------ floors
def test_a_floor_is_a_roofline() -> None:
    """Work of the processor adds up; memory and disk go on meanwhile."""
    assert Work(scalar=3, vector=2, png=1).floor(EACH) == 6
    assert Work(scalar=3, moved=5).floor(EACH) == 5 and Work(scalar=3, moved=2).floor(EACH) == 3
    assert Work(scalar=3, read=2, write=2).floor(EACH) == 4
    assert Work(scalar=3).floor(dataclasses.replace(EACH, scalar=2.0)) == 1.5
    assert Work(matrix=4, moved=3).bound(EACH) == "matrix" and Work().floor(EACH) == 0


def test_every_stage_of_a_plain_capture_has_a_floor_and_a_reason() -> None:
    """The reflectance stage works for light stages only."""
    assert [s.name for s in REGISTRY if s.name != "reflectance"] == list(STAGES) and STAGES.keys() == machine.WHY.keys()


def test_networks_are_those_of_the_fit(counts: Counts) -> None:
    """Products of a point are twice the weights of the two networks, without their biases."""
    width, depth = (int(counts.setting(f"inverse_rendering.{n}")) for n in ("width", "depth"))
    levels = int(counts.setting("inverse_rendering.hash_levels"))
    nets = mlp(2 * levels, width, depth, 5 + counts.rank), mlp(7, width, depth, counts.rank)
    weights = sum(p.numel() for net in nets for p in net.parameters() if p.ndim == 2)
    assert floors.shaded(counts)[0] == 2 * weights


def test_area_is_that_of_marching_cubes() -> None:
    from skimage.measure import marching_cubes

    x = np.linspace(-1.2, 1.2, 61)
    distance = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2) - 1
    _, faces, _, _ = marching_cubes(distance, 0.0)
    made = Counts(**{f.name: 0 for f in dataclasses.fields(Counts)})  # type: ignore[arg-type]
    ball = dataclasses.replace(made, faces=len(faces), cell=float(x[1] - x[0]))
    assert ball.area == pytest.approx(4 * math.pi, rel=0.02)


def test_work_grows_with_what_it_is_done_on(tmp_path: Path, counts: Counts) -> None:
    (tmp_path / "more").mkdir()
    more = counts_of(write_run(tmp_path / "more", manifests(photos=20)))
    for name in ("capture", "masks"):
        one, two = without_disk(STAGES[name](counts)), without_disk(STAGES[name](more))
        assert two == {k: pytest.approx(2 * v) for k, v in one.items()}, name
    steps = {**counts.settings, "inverse_rendering.steps": 2 * counts.settings["inverse_rendering.steps"]}
    grown = floors.inverse_rendering(dataclasses.replace(counts, settings=steps))
    assert grown.scalar > 1.5 * floors.inverse_rendering(counts).scalar - floors.depth_maps(counts)
    assert floors.bake(dataclasses.replace(counts, texels=2 * counts.texels)).matrix == 2 * floors.bake(counts).matrix


def test_what_was_not_made_costs_nothing(counts: Counts) -> None:
    assert floors.depth_maps(dataclasses.replace(counts, fitted=20)) == 2.5 * floors.depth_maps(counts) > 0
    for stereo, has in (("sweep", (True, False)), ("off", (False, False)), ("dense", (True, True))):
        changed = dataclasses.replace(counts, settings={**counts.settings, "inverse_rendering.stereo": stereo})
        assert (floors.swept(changed) > 0, floors.depth_maps(changed) > 0) == has
    assert floors.template(counts) == Work()
    unchecked = dataclasses.replace(counts, settings={**counts.settings, "poses.check": False})
    assert floors.poses(unchecked).jpeg == 0 and floors.poses(counts).jpeg == counts.jpeg


def test_an_empty_run_has_finite_floors(counts: Counts) -> None:
    """Extremes: no surface, no subject, nothing held out."""
    empty = dataclasses.replace(counts, faces=0, cell=0.0, subject=0.0, held=0, fitted=0, render=0, texels=0.0, rank=0)
    every = {f"{stage}.{k}": v for stage, own in settings().items() for k, v in own.items()}
    empty = dataclasses.replace(empty, settings=every)
    for name, of in STAGES.items():
        assert 0 <= of(empty).floor(EACH) < math.inf, name


# ------------------------------------------------------------------ counts
def test_counts_are_those_of_the_manifests(counts: Counts) -> None:
    assert (counts.photos, counts.fitted, counts.held) == (10, 8, 2)
    assert counts.jpeg == 10 * SIZE**2 and counts.png == 0 and counts.sources == 10_000
    assert counts.bytes["inverse_rendering"] == 5000 and counts.bytes["masks"] == 500
    assert counts.subject == 0.25 and not counts.solved and not counts.person
    assert counts.texels == 256**2 / 2 and counts.exr_maps == 4 * 256**2 and counts.png_maps == 3 * 256**2
    assert counts.setting("bake.size") == 1024 and counts.seconds["bake"] == 3.0


def test_kinds_of_photos_and_masks(tmp_path: Path) -> None:
    found = counts_of(write_run(tmp_path, manifests(kind="png", source="person+hull")))
    assert found.jpeg == 0 and found.png == 10 * SIZE**2 and found.person
    assert floors.masks(found).vector > 10 * floors.masks(dataclasses.replace(found, person=False)).vector


def test_files_are_found_at_any_depth() -> None:
    assert list(sizes({"a": [{"b": file("x", 3)}, file("y", 4)], "path": "z"})) == [3, 4]


def test_a_run_that_ended_early_is_counted_so_far(tmp_path: Path) -> None:
    made = {k: v for k, v in manifests().items() if k in ("capture", "poses", "masks")}
    found = counts_of(write_run(tmp_path, made))
    assert list(found.seconds) == ["capture", "poses", "masks"] and found.fitted == 8 and found.area == 0
    work = {name: STAGES[name](found) for name in found.seconds}
    assert [row[0] for row in machine.rows_of(work, found.seconds, EACH)] == ["capture", "poses", "masks", "all"]


def test_a_run_whose_store_was_cleared_is_named(tmp_path: Path) -> None:
    out = write_run(tmp_path, manifests())
    (tmp_path / "store/masks/k/manifest.json").unlink()
    with pytest.raises(StageError, match="no manifest of masks"):
        counts_of(out)
    with pytest.raises(StageError, match="holds no run"):
        counts_of(tmp_path / "nothing")


def test_a_setting_of_another_version_is_named(counts: Counts) -> None:
    with pytest.raises(StageError, match="masks.hull_cells"):
        floors.masks(dataclasses.replace(counts, settings={}))


# ------------------------------------------------------------------ the command
def given(*more: str) -> Any:
    return parser().parse_args(["bench", "machine", *more])


def test_the_command_measures_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measured: list[Path] = []

    def of(folder: Path) -> Rates:
        measured.append(folder)
        return Rates(**{name: 2 * unit for name, (_, unit, _) in machine.SHOWN.items()})

    monkeypatch.setattr(machine, "measured", of)
    run, out = write_run(tmp_path, manifests()), tmp_path / "machine"
    for _ in range(2):
        assert machine.run(given("--out", str(out), "--run", str(run)), Console()) == 0
    assert measured == [out]
    text = (out / "machine.md").read_text()
    assert text in capsys.readouterr().out and "| memory, copy | 2 GB/s |" in text
    assert len([line for line in text.splitlines() if line.split("|")[1:2] in ([f" {n} "] for n in STAGES)]) == 7
    assert machine.run(given(), Console()) == 0 and measured == [out, Path.cwd()]
    assert "floor" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"rates": {}, "machine": {}}', json.dumps({"rates": dict.fromkeys(machine.SHOWN, 0), "machine": {}})],
)
def test_a_file_that_is_no_measurement_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / machine.FILE).write_text(text)
    with pytest.raises(UsageError, match="no measurement of a machine"):
        machine.run(given("--out", str(tmp_path)), Console())


def test_figures_have_two_digits_and_no_exponent() -> None:
    assert [machine.amount(v) for v in (0, 0.004, 0.043, 1.26, 12.6, 126.4, 98765.0)] == [
        "0", "0", "0.043", "1.3", "13", "126", "98765"
    ]  # fmt: skip
    assert [machine.speed(v) for v in (2897.3, 133.4, 5.339)] == ["2,897", "133", "5.34"]
    assert machine.ratio(10, 4) == "2.5" and machine.ratio(10, 0) == "-"
