"""The whole pipeline, every stage real, on a small demo capture: the asset, what runs again, what SIGKILL leaves."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.artifacts import Located, sha256_of
from pipeline.capture_artifacts import Capture
from pipeline.demo.capture import write_demo_capture
from tests.support.points import PATIENCE, kill

pytestmark = pytest.mark.slow

SMALL = {
    "inverse_rendering.steps": 240,
    "inverse_rendering.batch": 1024,
    "inverse_rendering.grid_cells": 72,
    "inverse_rendering.levels": 2,
    "inverse_rendering.hash_log2_size": 14,
    "inverse_rendering.hash_fine": 0.003,
    "surface.resolution": 96,
    "uv.target_faces": 3000,
    "uv.proxy_faces": 800,
    "bake.size": 256,
    "usd.preview_size": 128,
}
LARGE = 20_000  # bytes
SHOWN = 40  # differences that a failure lists
STAGES = [
    "capture",
    "poses",
    "masks",
    "inverse_rendering",
    "surface",
    "template",
    "uv",
    "reflectance",
    "bake",
    "usd",
    "report",
]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    write_demo_capture(folder, views=16, size=96, samples=8, mesh_step=0.003)
    return folder


def start(
    environment: dict[str, str], capture: Path, out: Path, program: str = "workflows.cli", **changes: object
) -> subprocess.Popen[bytes]:
    sets = [f"--set={k}={v}" for k, v in {**SMALL, **changes}.items()]
    command = [sys.executable, "-m", program, "run", str(capture), "--out", str(out), "--preset", "draft"]
    return subprocess.Popen(
        [*command, "--holdout", "every:5:2", *sets],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def run(environment: dict[str, str], capture: Path, out: Path, **changes: object) -> dict[str, object]:
    child = start(environment, capture, out, **changes)
    _, err = child.communicate(timeout=PATIENCE)
    assert child.returncode == 0, err.decode()
    record: dict[str, object] = json.loads((out / "run.json").read_text())
    return record


def again(record: dict[str, object]) -> list[str]:
    """The stages that were made and not reused."""
    stages = record["stages"]
    assert isinstance(stages, dict)
    return [s for s in STAGES if not stages[s]["reused"]]


@pytest.fixture(scope="module")
def done(capture: Path, child_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbs, and that compiles every kernel anew, as the first run on a machine does."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    run({**child_environment, "NUMBA_CACHE_DIR": str(tmp_path_factory.mktemp("kernels"))}, capture, out)
    shutil.copy(out / "run.json", out.parent / "undisturbed.json")  # other tests run into this folder again
    return out


def test_the_asset_is_valid_and_close_to_the_truth(done: Path, capture: Path) -> None:
    from stages.usd.check.validate import validate
    from workflows.evaluation.demo import measure

    assert not [f for f in validate(done / "asset/head.usd") if f.level == "error"]
    record = json.loads((done / "run.json").read_text())
    folder = done / ".store/capture" / record["stages"]["capture"]["key"]
    manifest = Capture.model_validate_json((folder / "manifest.json").read_bytes())
    figures = measure(done, capture, Located(manifest, folder).artifact)
    assert figures.psnr > 24 and figures.psnr_asset > 22
    assert figures.accuracy_median < 2.5 and figures.completeness_mean < 5


def test_everything_promised_is_there(done: Path) -> None:
    promised = [
        "asset/lookdev.usda",
        "asset/head.usdz",
        "asset/environment.exr",
        "asset/internal/light.json",
        "run.json",
    ]
    promised += ["report/index.html", "report/metrics.json", "report/views/2.exr", "report/asset_views/2.exr"]
    promised += [f"asset/textures/head_{m}" for m in ("albedo.exr", "albedo.png", "normal.png", "f0.exr")]
    internal = (
        "specular_coefficients.exr",
        "shininess.exr",
        "inv_kappa.exr",
        "specular_intensity.exr",
        "basis_lut.exr",
    )
    promised += [f"asset/internal/head_{m}" for m in internal]
    assert [p for p in promised if not (done / p).is_file()] == []
    page = (done / "report/index.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page


def test_nothing_large_is_kept_twice(done: Path) -> None:
    """OUT and its store share what they have in common; the fit's views alone are copied (running.md, The store)."""
    stored: dict[str, set[int]] = {}
    for path in (done / ".store").rglob("*"):
        if path.is_file() and path.stat().st_size > LARGE:
            stored.setdefault(sha256_of(path), set()).add(path.stat().st_ino)
    shown = [p for n in ("asset", "report") for p in (done / n).rglob("*") if p.is_file() and p.stat().st_size > LARGE]
    own = [p for p in shown if p.parent != done / "report/views"]
    assert len(own) > 10
    assert [p.name for p in own if p.stat().st_ino not in stored.get(sha256_of(p), {p.stat().st_ino})] == []
    assert [p.parent for p in done.rglob("index.html")] == [done / "report"]


def test_only_what_depends_on_a_setting_runs_again(
    done: Path, capture: Path, child_environment: dict[str, str]
) -> None:
    assert again(run(child_environment, capture, done)) == []
    changed = run(child_environment, capture, done, **{"bake.size": 320})
    assert again(changed) == ["bake", "usd", "report"]


def test_a_changed_photo_runs_everything_again(
    done: Path, capture: Path, child_environment: dict[str, str], tmp_path: Path
) -> None:
    """Up to the masks, which is where the chain that follows is seen to begin anew."""
    copy = tmp_path / "capture"
    shutil.copytree(capture, copy)
    shutil.copy(copy / "1.png", copy / "0.png")
    command = [sys.executable, "-m", "workflows.cli", "run", str(copy), "--out", str(tmp_path / "out")]
    command += ["--holdout", "every:5:2", "--until", "poses", "--store", str(done / ".store")]
    subprocess.run(command, env=child_environment, check=True, capture_output=True, timeout=PATIENCE)
    before, after = (len(list((done / ".store" / s).glob("*[0-9a-f]"))) for s in ("masks", "capture"))
    assert (before, after) == (1, 2)


@pytest.fixture(scope="module")
def killed(capture: Path, child_environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SIGKILL to the whole process group: after the first stage, after the fit's 20th checkpoint, after the UVs."""
    out = tmp_path_factory.mktemp("killed") / "out"
    for name, sign in (
        ("capture.end", "capture/*"),
        ("fit.checkpoint@20", "inverse_rendering/*.scratch/checkpoint.pt"),
        ("uv.end", "uv/*"),
    ):
        point = kill(name, out.parent / name)
        child = start({**child_environment, **point.environment()}, capture, out, "tests.support.points")
        said = child.communicate(timeout=PATIENCE)
        assert child.returncode == -9 and point.reached() == [child.pid], said
        assert list((out / ".store").glob(sign))
        assert not (out / "asset").exists()
        finished = [p for p in (out / ".store").glob("*/*") if p.is_dir() and len(p.name) == 64]
        assert all((p / "manifest.json").is_file() for p in finished)
    run(child_environment, capture, out)
    return out


def folder(record: Path, out: Path, stage: str) -> Path:
    """Where a run left the result of a stage."""
    key = json.loads(record.read_text())["stages"][stage]["key"]
    return out / ".store" / stage / key


def manifest(record: Path, out: Path, stage: str) -> str:
    """The manifest that a run left of a stage."""
    return (folder(record, out, stage) / "manifest.json").read_text()


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """The single values of nested JSON, by their paths."""
    if not isinstance(value, dict | list):
        return {name: value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {k: v for key, item in items for k, v in leaves(item, f"{name}/{key}").items()}


def changed(before: str, after: str) -> list[str]:
    """The values of two manifests that differ, those that are no file's hash first."""
    was, now = leaves(json.loads(before)), leaves(json.loads(after))
    names = [k for k in {**was, **now} if was.get(k) != now.get(k)]
    return [f"{k}: {was.get(k)} -> {now.get(k)}" for k in sorted(names, key=lambda k: (k.endswith("/sha256"), k))]


def changed_arrays(before: Path, after: Path) -> list[str]:
    """The arrays of two folders' npz files that differ, and by how much at most."""
    out = []
    for file in sorted(before.glob("*.npz")):
        with np.load(file) as was, np.load(after / file.name) as now:
            for name in was.files:
                a, b = was[name], now[name]
                if a.shape != b.shape:
                    out.append(f"{file.name} {name}: {a.shape} -> {b.shape}")
                elif a.tobytes() != b.tobytes():
                    most = np.abs(a.astype(np.float64) - b.astype(np.float64)).max()
                    out.append(f"{file.name} {name}: {int((a != b).sum())} of {a.size} differ, by {most:.3g} at most")
    return out


def test_what_differs_is_told(tmp_path: Path) -> None:
    """A difference as it was never kept: of a value, of a file and in the last digit of an array."""
    old, new = ({"a": [1, {"sha256": h}], "psnr": p} for h, p in (("x", 30.0), ("y", 30.5)))
    assert changed(json.dumps(old), json.dumps(new)) == ["/psnr: 30.0 -> 30.5", "/a/1/sha256: x -> y"]
    for name, values in (("before", [1.0, 2.0]), ("after", [1.0, 2.0 + 2**-20])):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "field.npz", same=np.ones(3), table=np.array(values))
    told = changed_arrays(tmp_path / "before", tmp_path / "after")
    assert told == ["field.npz table: 1 of 2 differ, by 9.54e-07 at most"]


def test_a_run_killed_three_times_ends_in_a_valid_asset(done: Path, killed: Path) -> None:
    from stages.usd.check.validate import validate

    assert not [f for f in validate(killed / "asset/head.usd") if f.level == "error"]
    assert not list((killed / ".store").glob("*/*.partial-*"))


def test_a_run_killed_three_times_has_the_same_asset(done: Path, killed: Path) -> None:
    """Every stage from the photos to the asset, bit by bit. Where one differs, what differs is told: by its last digits
    a sum in another order is known, by more a state that was not kept."""
    for stage in STAGES[:-1]:
        pair = [(done.parent / "undisturbed.json", done, stage), (killed / "run.json", killed, stage)]
        before, after = (manifest(*one) for one in pair)
        if before == after:
            continue
        told = [*changed(before, after), *changed_arrays(*(folder(*one) for one in pair))]
        pytest.fail(f"{stage} is the first stage that differs:\n" + "\n".join(told[:SHOWN]), pytrace=False)
