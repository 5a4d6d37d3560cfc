"""`neuface bench captures`: which captures, how their runs end, and the table, with a toy in place of `neuface run`."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import toy_capture_run

from pipeline.errors import Cancelled, UsageError
from stages.capture.scan import scan_capture
from workflows.bench import captures as bench
from workflows.bench import captures_child as child
from workflows.bench.captures_against import compare
from workflows.bench.captures_find import DEFAULT_ROOT, HELD_OUT, NO_ALL_ON, NO_PHOTOS, find, root_of
from workflows.bench.captures_table import FIGURES, markdown
from workflows.cli.console import Console
from workflows.cli.main import parser

TOY = (sys.executable, str(Path(toy_capture_run.__file__)))


def photos(folder: Path, count: int = 3) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        (folder / f"{i}.jpg").write_bytes(bytes([i]) * 10)
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four captures whose names say how the toy ends, one in a sub-folder, and a light stage."""
    folder = tmp_path / "captures"
    for name in ("good_2", "bad_3", "broken_10"):
        photos(folder / name)
    photos(folder / "inner" / "images")
    (folder / "stage" / "olat").mkdir(parents=True)
    for name in ("params.json", "lights.json"):
        (folder / "stage" / name).write_text("{}")
    return folder


def options(root: Path, *more: str) -> argparse.Namespace:
    table = root.parent / "table.json"
    return parser().parse_args(["bench", "captures", "--root", str(root), "--out", str(root.parent / "out"), "--table",
                                str(table), *more])  # fmt: skip


def run(root: Path, *more: str) -> dict[str, Any]:
    assert bench.run(options(root, *more), Console(), TOY) == 0
    rows: dict[str, Any] = json.loads((root.parent / "table.json").read_text())["rows"]
    return rows


# ------------------------------------------------------------------ which captures
def test_what_is_run_of_each_folder(root: Path) -> None:
    photos(root / "head_a")
    (root / "empty").mkdir()
    found = {c.name: c for c in find(root)}
    assert found["inner"].capture == root / "inner" / "images" and found["inner"].folder == root / "inner"
    assert found["good_2"].capture == root / "good_2"
    assert found["stage"].skipped == NO_ALL_ON and found["empty"].skipped == NO_PHOTOS
    assert found["head_a"].holdout == HELD_OUT["head_a"] == "every:5:2" and found["good_2"].holdout == "every:8:3"
    assert {c.holdout for c in find(root, holdout="none")} == {"none"}
    assert [c.name for c in find(root, only=["good_2"])] == ["good_2"]


def test_a_light_stage_is_run_as_one(root: Path) -> None:
    """Its single lights belong to the run: what it needs is judged by them, not by the number of photos."""
    photos(root / "stage" / "full_on", 4)
    photos(root / "stage" / "olat" / "0")
    row = run(root, "--only", "stage")["stage"]
    assert row["ended"]["exit_code"] == 0 and "captures/stage --preset" in row["command"]
    asked = json.loads((root.parent / "out" / "stage" / "asked.json").read_text())
    assert Path(asked[1]) == root / "stage"
    (root / "stage" / "params.json").unlink()
    assert run(root, "--only", "stage")["stage"]["ended"]["error"] == NO_ALL_ON


def test_what_is_not_there_is_told(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such capture"):
        find(root, only=["nobody"])
    with pytest.raises(UsageError, match="no folder of captures"):
        root_of(str(tmp_path / "nowhere"))


@pytest.mark.parametrize("place", [".", "images"])
def test_a_truth_is_never_part_of_a_capture(tmp_path: Path, place: str) -> None:
    """Photos, masks and cameras in truth/ change nothing of what a run is given."""
    photos(tmp_path / place)
    (tmp_path / "mask").mkdir()
    [exclusive_run] = find(tmp_path.parent, only=[tmp_path.name])
    before = scan_capture(exclusive_run.capture).artifact
    photos(tmp_path / "truth")
    photos(tmp_path / "truth" / "mask")
    (tmp_path / "truth" / "params.json").write_text("{}")
    [beside] = find(tmp_path.parent, only=[tmp_path.name])
    assert beside == exclusive_run and scan_capture(beside.capture).artifact == before


# ------------------------------------------------------------------ how runs end
def test_one_failure_stops_no_other(root: Path) -> None:
    rows = run(root)
    ended = {n: (r["ended"]["exit_code"], r["ended"]["how"]) for n, r in rows.items()}
    assert ended == {
        "good_2": (0, "by itself"),
        "bad_3": (3, "by itself"),
        "broken_10": (1, "by itself"),
        "inner": (0, "by itself"),
        "stage": (None, "skipped"),
    }
    broken = rows["broken_10"]
    assert broken["ended"]["error"] == "the toy is broken (found: broken_10/7)"
    assert broken["ended"]["stage"] == "masks" and broken["seconds"] == {"capture": 1.5}
    assert broken["figures"] == {} and broken["verdict"]["level"] == "none"
    assert rows["bad_3"]["verdict"]["level"] == "unusable"
    assert rows["bad_3"]["verdict"]["reasons"] == ["masks agreement: the masks do not agree", "uv charts: many charts"]
    assert not any("fault" in r for r in rows.values())
    good = rows["good_2"]
    assert good["figures"]["asset_psnr"] == 20.0 and good["figures"]["held_out"] == 2
    assert good["seconds"] == {"capture": 2.0} and good["holdout"] == "every:8:3"
    assert str(root.parent) not in json.dumps(rows)  # nothing of this machine's folders


def test_a_toy_is_asked_for_what_a_run_is(root: Path) -> None:
    run(root, "--only", "inner", "--preset", "studio", "--holdout", "every:4:1")
    asked = json.loads((root.parent / "out" / "inner" / "asked.json").read_text())
    assert asked[0] == "run" and asked[1] == str(root / "inner" / "images")
    given = dict(zip(asked[2::2], asked[3::2], strict=True))
    assert given["--preset"] == "studio" and given["--holdout"] == "every:4:1"
    assert given["--store"] == str(root.parent / "out" / "store")


def test_an_old_result_is_not_taken_for_that_of_a_run_that_failed(root: Path) -> None:
    run(root, "--only", "good_2")
    (root / "good_2" / "fail").write_text("")
    row = run(root, "--only", "good_2")["good_2"]
    assert row["ended"]["exit_code"] == 1 and row["figures"] == {}
    (root / "good_2" / "fail").rename(root / "good_2" / "early")
    row = run(root, "--only", "good_2")["good_2"]
    assert row["ended"]["exit_code"] == 3 and row["figures"] == {} and row["seconds"] == {"capture": 1.5}


def test_a_run_that_never_ends_is_stopped(root: Path) -> None:
    (root / "good_2" / "hang").write_text("")
    row = run(root, "--only", "good_2", "--limit", "1s")["good_2"]
    assert row["ended"]["how"] == "time limit" and row["figures"] == {}
    assert "time limit" in (root.parent / "table.md").read_text()


def test_a_run_may_keep_its_checkpoint_before_it_ends(tmp_path: Path) -> None:
    polite = (
        "import pathlib, sys, time\ntry:\n    print('up', flush=True); time.sleep(600)\n"
        "except KeyboardInterrupt:\n    pathlib.Path(sys.argv[1]).write_text('kept')\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", polite, str(tmp_path / "kept")], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    with process.stdout:
        assert process.stdout.readline() == b"up\n"  # from here on it is in its try
        child._stop(process)
    assert (tmp_path / "kept").read_text() == "kept" and process.returncode == 0


@pytest.mark.slow
def test_what_does_not_let_go_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "GRACE", 0.2)
    deaf = "import signal, time; signal.signal(signal.SIGINT, signal.SIG_IGN); print('up', flush=True); time.sleep(600)"
    ended = child.run_child([], tmp_path / "log", 2.0, (sys.executable, "-c", deaf))
    assert ended.how == "time limit" and ended.seconds < 60


def test_a_termination_ends_the_run_too(root: Path) -> None:
    """The toy sends SIGTERM to the bench and then waits for its own end."""
    (root / "good_2" / "terminate").write_text("")
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(Cancelled, match="good_2"):
        run(root, "--only", "good_2")
    pid = int((root.parent / "out" / "good_2" / "pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_figure_that_is_not_finite_is_none() -> None:
    nan = float("nan")
    assert bench.finite({"a": nan, "b": [1.0, float("inf")], "c": {"d": nan, "e": "x"}, "f": 3}) == (
        {"a": None, "b": [1.0, None], "c": {"d": None, "e": "x"}, "f": 3}
    )


def test_the_last_error_is_kept() -> None:
    assert child.last_error(["error: first", "error: second", "  where: here", "  found: 3", "  limit: 4"]) == (
        "second (found: 3)"
    )
    assert child.last_error(["Traceback", "ValueError: 3", ""]) == "ValueError: 3"
    assert child.last_error([]) == "no message"


# ------------------------------------------------------------------ the table
def test_rows_that_were_not_run_stay(root: Path) -> None:
    first = run(root)
    (root / "good_2" / "better").write_text("")
    second = run(root, "--only", "good_2")
    assert second["good_2"]["figures"]["asset_psnr"] == 21.0
    assert {n: r for n, r in second.items() if n != "good_2"} == {n: r for n, r in first.items() if n != "good_2"}
    assert list(second) == sorted(second, key=bench.natural)
    (root / "inner").rename(root.parent / "elsewhere")
    assert "inner" in run(root, "--only", "good_2") and "inner" not in run(root)


def test_the_table_is_written_after_each_capture(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """bad_3 comes first; the second is interrupted."""
    calls: list[str] = []
    whole = bench.run_child

    def run_child(arguments: Any, *rest: Any) -> Any:
        calls.append(arguments[1])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return whole(arguments, *rest)

    monkeypatch.setattr(bench, "run_child", run_child)
    with pytest.raises(Cancelled):
        run(root)
    assert list(json.loads((root.parent / "table.json").read_text())["rows"]) == ["bad_3"]
    assert "bad_3" in (root.parent / "table.md").read_text()


def test_the_projects_table_is_for_the_usual_captures_alone(tmp_path: Path) -> None:
    def path(*more: str) -> Path:
        return bench.table_path(parser().parse_args(["bench", "captures", "--out", str(tmp_path), *more]))

    assert path() == path("--only", "head_a") == bench.TABLE
    assert path("--preset", "studio") == path("--root", "x") == path("--holdout", "none") == tmp_path / "captures.json"
    assert path("--table", "a/b.md") == Path("a/b.json")


def test_a_file_that_is_no_table_is_not_written_over(root: Path) -> None:
    path = root.parent / "table.json"
    path.write_text('{"format": 99, "rows": {}}')
    with pytest.raises(UsageError, match="table can't be read"):
        run(root)
    assert "99" in path.read_text()


def test_the_page_shows_every_row_and_explains_every_column(root: Path) -> None:
    rows = run(root)
    text = markdown(rows)
    assert "| bad_3 | 3 (unusable) | unusable | 3 of 4 | 2 | masks agreement: the masks do not agree;" in text
    assert "| broken_10 | 1 (failed) | none | - | - | the toy is broken (found: broken_10/7) |" in text
    assert "| good_2 | 19.50 | 19.60 | - | 20.00 | 20.10 | 0.6 | 1.4 | 0.900 | 0.800 | 25 | 12 | - | - |" in text
    shown = [line for line in text.splitlines() if line.startswith("| stage")]
    assert len(shown) == 2  # how it ended and how it was made; nothing was measured
    lines = text.splitlines()
    for at, line in enumerate(lines):
        if line.startswith("| ") and not lines[at - 1].startswith("|"):
            cells = line.count("|")
            assert lines[at + 1].count("|") == cells and lines[at + 2].count("|") == cells


# ------------------------------------------------------------------ against a stored table
def row(exit_code: int = 0, level: str = "good", **figures: float | None) -> dict[str, Any]:
    return {"ended": {"exit_code": exit_code, "how": "by itself"}, "verdict": {"level": level}, "figures": figures}


def test_only_what_changed_beyond_its_tolerance_is_told() -> None:
    old = {"a": row(asset_psnr=20.0, chamfer_mm=0.5, unseen=0.3, charts=10), "b": row(psnr=30.0), "gone": row()}
    new = {"a": row(asset_psnr=19.8, chamfer_mm=0.4, unseen=0.302, charts=14), "b": row(psnr=30.09), "fresh": row(3)}
    assert compare(old, new) == [
        "2 captures compared; changes within the tolerances are not shown",
        "a: asset_psnr [asset (dB)] 20.00 -> 19.80 (-0.20), worse",
        "a: chamfer_mm [chamfer (mm)] 0.50 -> 0.40 (-0.10), better",
        "fresh: new, 3 (unusable)",
        "gone: not in this table",
    ]
    assert compare(old, old)[1:] == ["no change"]


def test_endings_and_verdicts_are_compared() -> None:
    found = compare({"a": row(1, "none")}, {"a": row(3, "unusable", psnr=20.0)})
    assert found[1:] == [
        "a: exit 1 (failed) -> 3 (unusable), better",
        "a: verdict none -> unusable",
        "a: psnr [model (dB)] not measured before, 20.00 now",
    ]
    found = compare({"a": row(0, "good", psnr=20.0)}, {"a": row(0, "usable")})
    assert found[1:] == ["a: verdict good -> usable, worse", "a: psnr [model (dB)] was 20.00, not measured now"]


def test_seconds_of_a_busy_machine_say_little() -> None:
    assert compare({"a": row(seconds=100.0)}, {"a": row(seconds=105.0)})[1:] == ["no change"]
    assert compare({"a": row(seconds=100.0)}, {"a": row(seconds=120.0)})[1:] == [
        "a: seconds [in all] 100 -> 120 (+20), worse"
    ]


def test_every_figure_has_a_name_of_its_own() -> None:
    assert len({f.name for f in FIGURES}) == len(FIGURES)


def test_against_is_printed_at_the_end(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(root)
    table = root.parent / "table.json"
    before = root.parent / "before.json"
    before.write_bytes(table.read_bytes())
    (root / "good_2" / "better").write_text("")
    capsys.readouterr()
    run(root, "--only", "good_2", "--against", str(before))
    summary_line = capsys.readouterr().out
    assert "good_2: asset_psnr [asset (dB)] 20.00 -> 21.00 (+1.00), better" in summary_line
    assert "1 captures compared" in summary_line and "bad_3" not in summary_line
    with pytest.raises(UsageError, match="table can't be read"):
        run(root, "--against", str(root.parent / "nothing.json"))


def test_a_row_is_compared_with_the_one_that_it_replaces(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(root, "--only", "good_2")
    assert "captures compared" not in capsys.readouterr().out  # no row yet
    (root / "good_2" / "better").write_text("")
    run(root, "--only", "good_2")
    assert "good_2: asset_psnr [asset (dB)] 20.00 -> 21.00 (+1.00), better" in capsys.readouterr().out


def test_the_folders_beside_the_project_are_where_the_project_is() -> None:
    """They are counted from the modules' own places, which move."""
    root = Path(__file__).resolve().parents[2]
    assert root == bench.PROJECT and bench.TABLE.is_file()
    assert root.parent / "shared" / "captures" == DEFAULT_ROOT
    assert child._environment()["PYTHONPATH"].split(os.pathsep)[0] == str(root)
