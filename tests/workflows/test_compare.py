"""`neuface compare`: figures and maps of two runs, against what two made runs differ by, and bad input."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.browser import installed, tab
from support.synthetic_asset import ball
from support.synthetic_results import SyntheticResults, write_results

from pipeline.errors import StageError, UsageError
from pipeline.images import write_exr
from workflows.cli.main import main
from workflows.compare import figures, maps, surface, views
from workflows.compare.page import as_json, compare, html, lines
from workflows.compare.pictures import signed
from workflows.compare.runs import Side, read_side, read_sides

STAGES = ("capture", "poses", "masks", "uv", "bake", "usd")
FINDING = {"stage": "masks", "check": "hull_open", "level": "good", "said": "closed", "limit": "", "remedy": ""}


@dataclass
class Made:
    """A run's folder and its store."""

    out: Path
    store: Path


def make_run(folder: Path, results: SyntheticResults, name: str, psnr: float = 30.0, **more: Any) -> Made:
    """A published run with a store of its own. more: of metrics.json."""
    out, store = folder / name, folder / f"store_{name}"
    stages = {}
    for stage in STAGES:
        located = getattr(results, stage)
        shutil.copytree(located.folder, store / stage / "k")
        (store / stage / "k/manifest.json").write_text(located.artifact.model_dump_json())
        (store / stage / "k/run.json").write_text(json.dumps({"config": {"seed": 0, "size": len(name)}}))
        stages[stage] = {"key": "k", "seconds": 1.0, "peak_memory_mb": 100.0}
    (out / "report").mkdir(parents=True)
    views_of = {str(i): {"asset_psnr": psnr + i / 10} for i in (3, 9)}
    metrics = {"holdout": {"held_out": True, "views": 2, "psnr": 31.0, "asset_psnr": psnr, "per_view": views_of},
               "verdict": {"findings": [FINDING]}, "uv": {"faces": 3968}, **more}  # fmt: skip
    (out / "report/metrics.json").write_text(json.dumps(metrics))
    about = {"verdict": {"level": "good"}, "versions": {"numpy": "2"}, "asset": "asset/head.usd"}
    request = {"preset": "draft", "sets": []}
    record = {**about, "stages": stages, "store": str(store), "timing": {"total": 100.0}, "request": request}
    (out / "run.json").write_text(json.dumps(record))
    return Made(out, store)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SyntheticResults:
    return write_results(tmp_path_factory.mktemp("results"))


@pytest.fixture
def made(tmp_path: Path, results: SyntheticResults) -> tuple[Made, Made]:
    return make_run(tmp_path, results, "a"), make_run(tmp_path, results, "bb", psnr=30.5)


def changed(run: Made, path: str, edit: Any) -> None:
    """Edit a JSON file of the run's folder in place."""
    file = run.out / path
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def sides(made: tuple[Made, Made]) -> tuple[Side, Side]:
    return read_sides(made[0].out, made[1].out)


# ------------------------------------------------------------------ figures
def test_changes_are_judged_by_the_limits_of_the_table_of_captures(made: tuple[Made, Made]) -> None:
    changed(made[1], "report/metrics.json", lambda m: m["holdout"].update(psnr=31.05, asset_psnr=29.0))
    changed(made[1], "run.json", lambda r: r["timing"].update(total=80.0))
    found = {d.name: d for d in figures.differences(*sides(made))}
    assert (found["asset_psnr"].a, found["asset_psnr"].b, found["asset_psnr"].change) == ("30.00", "29.00", "-1.00")
    assert found["asset_psnr"].said == "worse"  # 1 dB is more than the noise of 0.1 dB, and less is worse
    assert found["psnr"].said == "within noise"  # 0.05 dB is not
    assert found["seconds"].said == "better"  # of the time less is better
    assert found["uv.faces"].said == "not judged"


def test_a_figure_that_one_run_lacks_is_not_judged_and_nonsense_is_no_figure(made: tuple[Made, Made]) -> None:
    changed(made[0], "report/metrics.json", lambda m: m["holdout"].pop("asset_psnr"))
    changed(made[1], "report/metrics.json", lambda m: m["uv"].update(faces="many"))
    found = {d.name: d for d in figures.differences(*sides(made))}
    assert (found["asset_psnr"].a, found["asset_psnr"].said) == ("-", "not judged")
    assert found["uv.faces"].b == "-"


def test_other_held_out_views_are_compared_over_the_common_ones(made: tuple[Made, Made]) -> None:
    changed(made[1], "report/metrics.json", lambda m: m["holdout"]["per_view"].pop("9"))
    found = {d.name: d for d in figures.differences(*sides(made))}
    assert (found["asset_psnr_common"].a, found["asset_psnr_common"].b) == ("30.30", "30.80")
    assert "1 views" in found["asset_psnr_common"].title


def test_checks_with_another_level_come_worst_first(made: tuple[Made, Made]) -> None:
    bad = {**FINDING, "level": "unusable", "said": "open"}
    other = {**FINDING, "stage": "uv", "check": "charts"}
    changed(
        made[0],
        "report/metrics.json",
        lambda m: m.update(verdict={"findings": [FINDING, {**other, "level": "usable"}]}),
    )
    changed(made[1], "report/metrics.json", lambda m: m.update(verdict={"findings": [bad, other]}))
    found = figures.changed_checks(*sides(made))
    assert [(c.check, c.a, c.b, c.step) for c in found] == [
        ("hull_open", "good", "unusable", -2),
        ("charts", "usable", "good", 1),
    ]


def test_settings_come_from_what_the_stages_ran_with(made: tuple[Made, Made]) -> None:
    changed(made[1], "run.json", lambda r: r["versions"].update(numpy="3"))
    found = figures.different_settings(*sides(made))
    assert found == {**{f"{s}.size": (1, 2) for s in STAGES}, "version of numpy": ("2", "3")}


# ------------------------------------------------------------------ views
def test_photos_are_paired_by_content_and_the_largest_changes_come_first(made: tuple[Made, Made]) -> None:
    changed(made[1], "report/metrics.json", lambda m: m["holdout"]["per_view"].update({"9": {"asset_psnr": 20.0}}))
    a, b = sides(made)
    assert [round(p.psnr[1] - p.psnr[0], 2) for p in views.pairs(a, b) if p.psnr] == [-10.9, 0.5]
    rows = list(views.rows(a, b))
    assert [p.caption for p in rows[0].pictures] == ["photo", "A, 30.9 dB", "B, 20.0 dB", "A and B apart",
                                                     "nearer to the photo: blue B, orange A"]  # fmt: skip
    for view in b.run.manifest("capture")["views"]:
        view["image"]["sha256"] = f"other {view['index']}"
    assert views.pairs(a, b) == []


def test_the_signed_scale() -> None:
    """Near white for equal values, blue above, orange below, clipped at the ends."""
    low, zero, high, beyond, unknown = signed(np.array([-1, 0, 1, 9, np.nan], np.float32), 1.0)
    assert (zero == 245).all() and (unknown == 245).all() and (high == beyond).all()
    assert high[2] > high[0] and low[0] > low[2]


# ------------------------------------------------------------------ surfaces
def save_ball(path: Path, radius: float = 1.0, *, turned: bool = False) -> Path:
    mesh = ball()
    mesh["vertices"] = (mesh["vertices"] * radius).astype(np.float32)
    if turned:  # the same surface in charts that are mirrored and moved
        mesh["uvs"] = (1 - mesh["uvs"] * 0.7).astype(np.float32)
    np.savez(path, **mesh)
    return path


def test_a_map_is_looked_up_where_the_other_chart_has_the_place(tmp_path: Path) -> None:
    """B is A's surface in other charts; a map of B that holds its own height shows A's heights in A's charts."""
    ours = surface.sheet(save_ball(tmp_path / "a.npz"), surface.GRID)
    theirs = surface.sheet(save_ball(tmp_path / "b.npz", turned=True), surface.DENSE)
    uv, distance = surface.nearest(ours, theirs, np.eye(4))
    height = np.full((theirs.size, theirs.size, 1), np.nan, np.float32)
    height[theirs.at[:, 1], theirs.at[:, 2], 0] = theirs.points[:, 1]
    seen = surface.looked_up(height, uv)[:, 0]
    known = np.isfinite(seen)
    assert known.mean() > 0.97 and np.abs(seen - ours.points[:, 1])[known].max() < 1.5e-3
    assert np.nanmax(np.abs(distance)) < 1e-4
    assert surface.same_charts(tmp_path / "a.npz", tmp_path / "a.npz")
    assert not surface.same_charts(tmp_path / "a.npz", tmp_path / "b.npz")


def test_the_distance_is_signed_and_unknown_far_away(tmp_path: Path) -> None:
    ours = surface.sheet(save_ball(tmp_path / "a.npz"), 64)
    inside = surface.sheet(save_ball(tmp_path / "b.npz", 0.99), surface.DENSE)
    distance = surface.nearest(ours, inside, np.eye(4))[1]
    apart = np.linalg.norm(ours.points, axis=1) * 0.01  # of two balls 1 % apart, along the rays; less along the normals
    assert np.isfinite(distance).all() and (distance > 0.8 * apart).all() and (distance < 1.02 * apart).all()
    moved = np.diag([0.99, 0.99, 0.99, 1.0])
    outside = surface.sheet(save_ball(tmp_path / "c.npz"), surface.DENSE)
    assert np.nanmean(surface.nearest(ours, outside, moved)[1]) == pytest.approx(distance.mean(), rel=0.02)
    far = surface.sheet(save_ball(tmp_path / "d.npz", 0.9), surface.DENSE)
    assert np.isnan(surface.nearest(ours, far, np.eye(4))[1]).all()


def plane(height: float, up: float, u: float) -> surface.Sheet:
    """A sheet of 1 cm x 1 cm at z = height that faces up or down, with u as all its texture coordinates."""
    x, y = np.meshgrid(np.linspace(0, 0.01, 20), np.linspace(0, 0.01, 20))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1)
    one = np.ones((len(points), 1))
    return surface.Sheet(np.zeros((len(points), 3), np.int64), one * [u, 0.5], points, one * [0, 0, up], 1, 20)


def test_of_two_near_sheets_the_one_that_faces_the_same_way_is_the_place() -> None:
    """As of a lip: the other side is at 0.5 mm, the right one at 2 mm."""
    front, back = plane(-0.002, 1, 0.25), plane(0.0005, -1, 0.75)
    lip = [np.concatenate(x) for x in zip(*[(s.at, s.uv, s.points, s.normals) for s in (front, back)], strict=True)]
    uv, distance = surface.nearest(plane(0.0, 1, 0.5), surface.Sheet(*lip[:4], 1, 20), np.eye(4))
    assert (uv[:, 0] == 0.25).all() and distance == pytest.approx(0.002)
    assert np.isnan(surface.nearest(plane(0.0, 1, 0.5), back, np.eye(4))[1]).all()  # only the wrong side is there


def test_cameras_place_one_run_on_the_other(made: tuple[Made, Made]) -> None:
    """B's world is A's, twice as large and moved."""
    changed(made[1], "run.json", lambda r: r["stages"]["poses"].update(key="other"))
    (made[1].store / "poses/k").rename(made[1].store / "poses/other")
    a, b = sides(made)
    for camera in b.run.manifest("poses")["cameras"]:
        pose = np.array(camera["world_from_cam"])
        pose[:3, 3] = 2 * pose[:3, 3] + [1, 2, 3]
        camera["world_from_cam"] = pose.tolist()
    found = surface.a_from_b(a, b)
    assert not isinstance(found, str)
    assert np.abs(found[0] @ [3, 4, 5, 1] - [1, 1, 1, 1]).max() < 1e-9 and found[1] < 1e-9
    b.run.manifest("poses")["cameras"] = b.run.manifest("poses")["cameras"][:2]
    assert "fewer than three" in str(surface.a_from_b(a, b))
    b.run.manifest("poses")["cameras"] = [
        {**c, "world_from_cam": np.block([[np.eye(3), np.full((3, 1), i)], [0, 0, 0, 1]]).tolist()}
        for i, c in enumerate(a.run.manifest("poses")["cameras"])
    ]
    assert "on one line" in str(surface.a_from_b(a, b))


def test_maps_differ_by_what_they_were_changed_by(made: tuple[Made, Made]) -> None:
    """F0 of B is 0.01 above A's everywhere."""
    a, b = sides(made)
    ref = b.run.manifest("bake")["maps"]["f0"]["files"]["exr"]
    path = made[1].store / "bake/k" / ref["path"]
    values = maps._read(b, "f0")
    assert values is not None
    write_exr(path, values + np.float32(0.01))
    rows = {r.title: r for r in maps.rows(a, b, surface.matched(a, b))}
    assert rows["F0"].note == "mean difference 0.01, median of its size 0.01"
    assert rows["roughness"].note == "mean difference 0, median of its size 0"
    assert rows["normal"].note.startswith("mean difference 0,") and len(rows["F0"].pictures) == 3
    assert rows["Shape: distance of the two surfaces"].note.startswith("median 0.00")
    alone = {r.title: r for r in maps.rows(a, b, "no match")}
    assert [p.caption[:1] for p in alone["F0"].pictures] == ["A", "B"]


# ------------------------------------------------------------------ the page, and bad input
def test_the_page_and_the_lines_say_what_differs(made: tuple[Made, Made]) -> None:
    found = compare(*sides(made))
    text, page = "\n".join(lines(found)), html(found)
    assert found.notes == []
    assert "better: PSNR of the asset (dB) 30.00 -> 30.50 (+0.50)" in text and "setting: bake.size 1 -> 2" in text
    for heading in ("Figures", "Settings that differ", "Held-out views", "Maps", "From three sides"):
        assert f"<h2>{heading}</h2>" in page
    assert "<script" not in page and 'src="data:' in page and "http" not in page.replace("http-equiv", "")
    json.dumps(as_json(found))


def test_names_are_escaped(made: tuple[Made, Made]) -> None:
    evil = {**FINDING, "level": "usable", "said": "<script>alert(1)</script>"}
    changed(made[1], "report/metrics.json", lambda m: m.update(verdict={"findings": [evil]}))
    assert "<script>alert" not in html(compare(*sides(made)))


def test_folders_that_are_no_runs_are_refused_by_name(made: tuple[Made, Made], tmp_path: Path) -> None:
    (tmp_path / "batch_out/batch").mkdir(parents=True)
    shutil.copytree(made[0].out, tmp_path / "batch_out/anna")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/run.json").write_text("[1")
    for folder, found in (("nowhere", "no such folder"), ("batch_out", "a batch"), ("broken", "no run.json")):
        with pytest.raises(StageError, match=found) as caught:
            read_sides(made[0].out, tmp_path / folder)
        assert folder in str(caught.value)
    with pytest.raises(StageError, match="batch_out/anna"):
        read_side("B", tmp_path / "batch_out")
    with pytest.raises(UsageError, match="the same run"):
        read_sides(made[0].out, made[0].out / ".." / made[0].out.name)


def test_what_is_missing_is_told_and_the_rest_is_shown(made: tuple[Made, Made]) -> None:
    """No metrics, no verdict, no store: settings and figures of the other run stay."""
    (made[1].out / "report/metrics.json").unlink()
    changed(made[1], "run.json", lambda r: r.pop("verdict"))
    shutil.rmtree(made[1].store)
    found = compare(*sides(made))
    notes = "\n".join(found.notes)
    assert "no verdict" in notes and "metrics.json" in notes and "no longer has capture, poses" in notes
    assert found.views == [] and found.maps and found.differences
    assert "no longer has" in html(found) and figures.level(found.b) == "none"


@pytest.mark.parametrize("stage", STAGES)
def test_a_damaged_manifest_or_file_costs_its_own_part_only(made: tuple[Made, Made], stage: str) -> None:
    for path in (made[1].store / stage / "k").rglob("*"):
        if path.is_file() and path.name != "manifest.json":
            path.write_bytes(b"damaged")
    found = compare(*sides(made))
    assert html(found) and found.differences
    (made[1].store / stage / "k/manifest.json").write_text('{"views": 3, "masks": [7], "maps": [], "cameras": "x"}')
    found = compare(*sides(made))
    told = ("can't be shown", "no photo", "mesh is not", "no such", f"no longer has {stage}")
    quiet = ("poses", "masks")  # equal keys need no cameras; without a mask one picture of five is left out
    assert html(found) and (stage in quiet or any(t in n for n in found.notes for t in told)), found.notes


def test_other_captures_are_told(made: tuple[Made, Made]) -> None:
    path = made[1].store / "capture/k/manifest.json"
    path.write_text(path.read_text().replace('"sha256":"', '"sha256":"0'))
    found = compare(*sides(made))
    assert len(found.notes) == 1 and found.notes[0].startswith("different captures: ")
    assert found.views == [] and found.placed == {} and len(found.maps) > 2
    assert not any("distance" in r.title for r in found.maps)


def test_the_command(made: tuple[Made, Made], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "side by side"
    assert main(["compare", str(made[0].out), str(made[1].out), "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"page: {out / 'index.html'}"
    (out / "index.html").write_text("mine")
    assert main(["compare", str(made[0].out), str(made[1].out), "--out", str(out), "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out) == json.loads((out / "compare.json").read_text())
    assert (out / "index.html.yours-1").read_text() == "mine" or "yours" in told.err
    assert main(["compare", str(made[0].out), str(tmp_path / "nowhere"), "--out", str(out)]) == 1
    assert "no such folder" in capsys.readouterr().err


@pytest.mark.slow
def test_the_page_in_a_browser(made: tuple[Made, Made], tmp_path: Path) -> None:
    if installed() is None:
        pytest.skip("no Chromium is installed")
    page = tmp_path / "page.html"
    page.write_text(html(compare(*sides(made))))
    with tab(tmp_path / "profile") as found:
        found.size(390, 844, phone=True)
        found.call("Page.navigate", url=page.as_uri())
        found.until("document.readyState === 'complete'")
        assert found.run("document.documentElement.scrollWidth") <= 390
        assert found.run("[...document.images].every(i => i.naturalWidth > 0)")
        assert found.troubles == [] and all(r.startswith(("file:", "data:")) for r in found.requests)
        image = cv2.imdecode(np.frombuffer(found.picture(), np.uint8), cv2.IMREAD_COLOR)
        assert image.std() > 5
