"""Which captures, what happens to each, when it is tried again, what the table and the page say."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import Cancelled, DiskError, StageError, TimeLimitError, UsageError
from pipeline.verdict import Level
from workflows.batch import captures, failures
from workflows.batch.captures import NAME, find, ranges
from workflows.batch.failures import Failure, failure_in, failure_of, smaller
from workflows.batch.loop import Ended, run_batch
from workflows.batch.page import ODD, Row, ranked, write_page
from workflows.batch.request import BatchRequest, asset_name
from workflows.batch.state import BatchState, Entry, Summary, fingerprint, idempotency_key
from workflows.cli.options import seconds
from workflows.run.request import RunRequest


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    root = tmp_path / "tree"
    for name in ("1/1_neutral", "1/2_smile", "2/1_neutral", "10/1_neutral", "10/16_grin"):
        (root / name).mkdir(parents=True)
        (root / name / "params.json").write_text("{}")
        (root / name / "0.jpg").write_bytes(name.encode())
    return root


# ------------------------------------------------------------------ which captures
def test_a_tree_in_natural_order_and_its_filters(tree: Path) -> None:
    names = [i.name for i in find(tree)]
    assert names == ["1/1_neutral", "1/2_smile", "2/1_neutral", "10/1_neutral", "10/16_grin"]
    assert [i.name for i in find(tree, "1-2")] == names[:3]
    assert [i.name for i in find(tree, "2,10", "1")] == ["2/1_neutral", "10/1_neutral"]
    assert [i.name for i in find(tree, None, "2-16")] == ["1/2_smile", "10/16_grin"]


def test_photos_without_params_are_a_fault_and_not_passed_over(tree: Path) -> None:
    (tree / "2/1_neutral/params.json").unlink()
    item = next(i for i in find(tree) if i.name == "2/1_neutral")
    assert item.fault is not None and "params.json is missing" in item.fault


@pytest.mark.parametrize("text", ["", "a", "3-1", "1,,2", "-1", "1-2-3", "1 2"])
def test_filters_that_can_not_be_read(tree: Path, text: str) -> None:
    with pytest.raises(UsageError, match="filter"):
        find(tree, text)


@given(st.lists(st.tuples(st.integers(0, 999), st.integers(0, 99)), min_size=1, max_size=5))
def test_ranges_read_back_what_was_written(pairs: list[tuple[int, int]]) -> None:
    wanted = [(low, low + more) for low, more in pairs]
    assert ranges(",".join(f"{a}-{b}" if a < b else f"{a}" for a, b in wanted), "--x") == wanted


def test_nothing_left_by_the_filters_and_nothing_at_all(tree: Path, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="5 found, 0 left"):
        find(tree, "77")
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "gone", tree / "1/1_neutral/params.json.txt"):
        with pytest.raises(StageError):
            find(place)


def test_lists_in_csv_and_json_are_the_same(tree: Path) -> None:
    rows = [{"capture": "1/1_neutral", "subject": "1", "expression": "1_neutral"},
            {"capture": str(tree / "2/1_neutral"), "name": "anna", "preset": "studio", "seed": 3}]  # fmt: skip
    (tree / "a.json").write_text(json.dumps(rows))
    with (tree / "a.csv").open("w") as f:
        table = csv.DictWriter(f, ["capture", "name", "subject", "expression", "preset", "seed"])
        table.writeheader()
        table.writerows(rows)
    first, second = find(tree / "a.json"), find(tree / "a.csv")
    assert first == second
    assert [(i.name, i.capture, i.own) for i in first] == [
        ("1/1_neutral", tree / "1/1_neutral", {}),
        ("anna", tree / "2/1_neutral", {"preset": "studio", "seed": 3}),
    ]


@pytest.mark.parametrize(
    "rows",
    ["[1", "{}", "3", '[{"name": "a"}]', '[{"capture": ""}]', '[{"capture": "x", "sed": 1}]', "[" * 100_000,
     '[{"capture": "x", "seed": -1}]', '[{"capture": "x"}, {"capture": "y/x"}]'],
)  # fmt: skip
def test_lists_that_can_not_be_read(tmp_path: Path, rows: str) -> None:
    (tmp_path / "a.json").write_text(rows)
    with pytest.raises(UsageError):
        find(tmp_path / "a.json")


ESCAPES = ["../x", "/etc/x", "a/../../b", "..", ".", "a/b/c", ".hidden", "a/.x", "a\\..\\b", "", " ", "a\nb", "a/", "~",
           "batch", "batch/index.html", "é" * 3, "a" * 65, "-rf"]  # fmt: skip


@pytest.mark.parametrize("name", ESCAPES)
def test_names_from_a_list_never_leave_the_out_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps([{"capture": "x", "name": name}]))
    try:
        assert [i.name for i in find(tmp_path / "a.json")] == ["x"]  # an empty name is none: the folder's is taken
        assert name in ("", " ")
    except UsageError:
        pass


@given(st.text(max_size=20))
def test_every_name_that_passes_stays_inside(name: str) -> None:
    if NAME.fullmatch(name):
        out = Path("/runs/out")
        assert out in (out / name).resolve().parents
        assert asset_name(name).isidentifier()


# ------------------------------------------------------------------ faults
@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (StageError("x", where=1, value=1, limit=1, remedy="x"), "capture"),
        (UsageError("x", where=1, value=1, limit=1, remedy="x"), "capture"),
        (DiskError("x", where=1, value=1, limit=1, remedy="x"), "disk"),
        (TimeLimitError("x", where=1, value=1, limit=1, remedy="x"), "limit"),
        (Cancelled("x"), "stopped"),
        (MemoryError("x"), "memory"),
        (RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), "memory"),
        (RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate"), "memory"),
        (ZeroDivisionError("x"), "bug"),
    ],
)
def test_kinds_of_faults(error: Exception, kind: str) -> None:
    assert failure_of(error).kind == kind
    in_state = failure_in(f"Flow run encountered an exception: {type(error).__name__}: {error}")
    assert in_state.kind == kind  # as Prefect words it
    assert in_state.passes == (kind in ("memory", "lost"))


@pytest.mark.parametrize("name", ["ConnectError", "ReadTimeout", "RemoteProtocolError", "PrefectHTTPStatusError"])
def test_a_server_that_was_away_may_be_back(name: str) -> None:
    assert failure_in(f"Flow run encountered an exception: {name}: all connection attempts failed").kind == "lost"


def test_half_the_rays_until_it_makes_no_sense() -> None:
    assert smaller(4096) == "inverse_rendering.batch=2048"
    assert smaller(512) == "inverse_rendering.batch=256"
    assert smaller(511) is None


@pytest.mark.parametrize(("text", "value"), [("90", 90), ("90s", 90), ("1.5h", 5400), ("7d", 604800), ("2m", 120)])
def test_times(text: str, value: float) -> None:
    assert seconds(text) == value


@pytest.mark.parametrize("text", ["", "0", "-1", "1w", "h", "1e3", "nan", "inf"])
def test_times_that_are_none(text: str) -> None:
    with pytest.raises(ValueError):
        seconds(text)


# ------------------------------------------------------------------ the loop
class Scripted:
    """A Runner whose runs end as a script says: a list of faults for each capture, None when done."""

    slots = 2

    def __init__(
        self,
        out: Path,
        script: dict[str, list[Failure | None]],
        batch: int = 4096,
        levels: dict[str, Level] | None = None,
    ) -> None:
        self.out, self.script, self.batch, self.levels = out, script, batch, levels or {}
        self.started: list[tuple[str, int, tuple[str, ...]]] = []
        self.under_way: list[str] = []
        self.most = 0

    def start(self, entry: Entry, request: RunRequest) -> None:
        self.started.append((entry.name, entry.attempt, request.sets))
        self.under_way.append(entry.name)
        self.most = max(self.most, len(self.under_way))

    def poll(self) -> Iterable[Ended]:
        if not self.under_way:
            return []
        name = self.under_way.pop(0)
        fault = self.script.get(name, [None]).pop(0) if self.script.get(name) else None
        if fault is None:
            (self.out / name).mkdir(parents=True, exist_ok=True)
            (self.out / name / "run.json").write_text("{}")
        return [Ended(name, fault, self.batch, self.levels.get(name))]

    def close(self, stopped: bool) -> Iterable[Ended]:
        ended = [Ended(n, Failure(kind="stopped", message="stopped")) for n in self.under_way]
        self.under_way = []
        return ended


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failures, "BACK_OFF", 0.01)


def request(tree: Path, **changes: Any) -> BatchRequest:
    return BatchRequest(root=str(tree), out=str(tree.parent / "out"), **changes)


LOST, MEMORY = Failure(kind="lost", message="gone"), Failure(kind="memory", message="full")
BAD, DISK = Failure(kind="capture", message="bad photo\nmore"), Failure(kind="disk", message="no space")


def go(tree: Path, script: dict[str, list[Failure | None]], **changes: Any) -> tuple[Any, Scripted]:
    asked = request(tree, **changes)
    runner = Scripted(Path(asked.out), script)
    return run_batch(asked, runner), runner


def test_one_bad_capture_costs_no_other_and_is_not_tried_again(tree: Path) -> None:
    summary, runner = go(tree, {"2/1_neutral": [BAD]})
    assert summary.counts() == {"done": 4, "unusable": 0, "failed": 1, "submitted": 0, "waiting": 0}
    assert len(runner.started) == 5 and runner.most == 2
    assert summary.failed == 1


def test_what_may_pass_is_tried_again_as_often_as_asked(tree: Path) -> None:
    summary, runner = go(tree, {"1/1_neutral": [LOST, LOST], "1/2_smile": [LOST] * 5}, attempts=3)
    tries = {n: [a for name, a, _ in runner.started if name == n] for n in ("1/1_neutral", "1/2_smile")}
    assert tries == {"1/1_neutral": [1, 2, 3], "1/2_smile": [1, 2, 3]}
    assert summary.counts()["failed"] == 1


def test_an_unusable_result_is_an_end_and_is_not_tried_again(tree: Path) -> None:
    asked = request(tree)
    levels: dict[str, Level] = {"1/1_neutral": "unusable", "1/2_smile": "usable", "2/1_neutral": "good"}
    summary = run_batch(asked, Scripted(Path(asked.out), {}, levels=levels))
    assert summary.counts() == {"done": 4, "unusable": 1, "failed": 0, "submitted": 0, "waiting": 0}
    assert (summary.failed, summary.refused(False), summary.refused(True)) == (0, 1, 2)
    again = Scripted(Path(asked.out), {})
    later = run_batch(asked, again)  # what is known is on disk
    assert again.started == [] and later.counts()["unusable"] == 1 and later.refused(True) == 2
    (Path(asked.out) / "1/1_neutral/run.json").unlink()
    run_batch(asked, again)
    assert [name for name, *_ in again.started] == ["1/1_neutral"]


@pytest.mark.parametrize(("change", "again"), [({"strict": True}, 0), ({"force": True}, 5)])
def test_strict_makes_nothing_anew_and_force_does(tree: Path, change: dict[str, bool], again: int) -> None:
    go(tree, {})
    _, runner = go(tree, {}, **change)
    assert len(runner.started) == again


@pytest.mark.parametrize(
    ("script", "levels", "options", "code"),
    [
        ({}, {"2/1_neutral": "good"}, ["--strict"], 0),
        ({}, {"2/1_neutral": "usable"}, [], 0),
        ({}, {"2/1_neutral": "usable"}, ["--strict"], 3),
        ({}, {"2/1_neutral": "unusable"}, [], 3),
        ({"1/2_smile": [Failure(kind="capture", message="bad")]}, {"2/1_neutral": "unusable"}, [], 1),
    ],
)
def test_exit_codes_of_a_batch(
    tree: Path,
    monkeypatch: pytest.MonkeyPatch,
    script: dict[str, list[Failure | None]],
    levels: dict[str, Level],
    options: list[str],
    code: int,
) -> None:
    from workflows.batch import local
    from workflows.cli.main import main

    out = tree.parent / "out"
    runner = Scripted(out, script, levels=levels)
    runner.kill = lambda: None  # type: ignore[attr-defined]
    monkeypatch.setattr(local, "Processes", lambda request, slots: runner)
    assert main(["batch", str(tree), "--out", str(out), *options]) == code


def test_out_of_memory_is_tried_with_half_the_rays(tree: Path) -> None:
    asked = request(tree, subjects="2")
    runner = Scripted(Path(asked.out), {"2/1_neutral": [MEMORY, MEMORY]})
    assert run_batch(asked, runner).failed == 0
    half = ("inverse_rendering.batch=2048",)  # twice the same: the script's fit always has 4096
    assert [sets for _, _, sets in runner.started] == [(), half, half]


def test_a_full_disk_stops_the_batch_and_the_same_command_goes_on(tree: Path) -> None:
    summary, runner = go(tree, {"1/1_neutral": [DISK]})
    assert summary.held is not None and summary.counts()["waiting"] == 3
    again, runner = go(tree, {})
    assert again.failed == 0
    assert len(runner.started) == 4


def test_a_second_command_touches_only_what_is_not_done(tree: Path) -> None:
    go(tree, {"2/1_neutral": [BAD]})
    _, runner = go(tree, {})
    assert runner.started == [("2/1_neutral", 2, ())]
    _, runner = go(tree, {})
    assert runner.started == []


@pytest.mark.parametrize("change", ["photo", "setting", "result gone"])
def test_done_is_forgotten_when_it_is_no_longer_true(tree: Path, change: str) -> None:
    go(tree, {})
    options: dict[str, Any] = {}
    if change == "photo":
        (tree / "1/1_neutral/0.jpg").write_bytes(b"another")
    elif change == "setting":
        options = {"seed": 1}
    else:
        (tree.parent / "out/1/1_neutral/run.json").unlink()
    _, runner = go(tree, {}, **options)
    assert len(runner.started) == (5 if change == "setting" else 1)


def test_ctrl_c_leaves_what_was_under_way_waiting(tree: Path) -> None:
    asked = request(tree)
    runner = Scripted(Path(asked.out), {})
    with pytest.raises(Cancelled):
        run_batch(asked, runner, stopped=lambda: len(runner.started) >= 2)
    states = [BatchState(asked.folder).read(i).state for i in find(tree)]
    assert sorted(states) == ["done", "waiting", "waiting", "waiting", "waiting"]
    assert (asked.folder / "index.html").is_file()


def test_a_batch_that_was_killed_joins_what_it_submitted(tree: Path) -> None:
    """The same attempt, so the same idempotency key: a server hands back the run that it has."""
    asked = request(tree, subjects="2")
    state, item = BatchState(asked.folder), find(tree, "2")[0]
    run = asked.run_request(item.capture, item.name, (), item.own)
    entry = Entry(name=item.name, capture=str(item.capture), state="submitted", attempt=4, fingerprint=fingerprint(run))
    state.write(entry)
    runner = Scripted(Path(asked.out), {})
    run_batch(asked, runner)
    assert runner.started == [("2/1_neutral", 4, ())]


def test_idempotency_keys_differ_by_all_that_matters(tree: Path) -> None:
    base = Entry(name="a", capture="/c", attempt=1, fingerprint="f")
    others = [base.model_copy(update=u) for u in ({"name": "b"}, {"attempt": 2}, {"fingerprint": "g"})]
    keys = [idempotency_key(e, "/out") for e in (base, *others)] + [idempotency_key(base, "/other")]
    assert len(set(keys)) == 5
    assert idempotency_key(base.model_copy(update={"state": "failed"}), "/out") == keys[0]


@pytest.mark.parametrize("content", [b"", b"{", b'{"name": "../x", "capture": "c"}', b'{"name":"a","asset":"/etc/x"}'])
def test_a_damaged_ledger_is_a_new_one(tree: Path, content: bytes) -> None:
    state, item = BatchState(tree.parent / "out/batch"), find(tree)[0]
    state.write(Entry(name=item.name, capture="c", state="done"))
    next(state.folder.iterdir()).write_bytes(content)
    assert state.read(item).state == "waiting"


def test_results_never_land_among_the_captures(tree: Path) -> None:
    for out in (tree, tree / "out"):
        with pytest.raises(StageError, match="among the captures"):
            run_batch(BatchRequest(root=str(tree), out=str(out)), Scripted(out, {}))
    assert not (tree / "out").exists()


@pytest.mark.parametrize("change", [{"preset": "besst"}, {"sets": ("bake.size=x",)}, {"until": "baek"}, {"seed": 2.5}])
def test_wrong_words_are_told_before_anything_is_written(tree: Path, change: dict[str, Any]) -> None:
    with pytest.raises((UsageError, ValueError)):
        run_batch(request(tree, **change), Scripted(tree, {}))
    assert not (tree.parent / "out").exists()


@pytest.mark.parametrize("option", [["--attempts", "0"], ["--seed", "-1"], ["--preset", "besst"], ["--chunk", "9999"]])
def test_wrong_options_are_exit_code_2(tree: Path, option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    from workflows.cli.main import main

    assert main(["batch", str(tree), "--out", str(tree.parent / "out"), *option]) == 2
    assert "what to do:" in capsys.readouterr().err


# ------------------------------------------------------------------ table and page
def rows(figures: list[float]) -> list[Row]:
    return [Row(f"c{i}", "done", 1, figures={"psnr": v}) for i, v in enumerate(figures)]


def test_failed_first_then_the_odd_ones_then_by_name() -> None:
    table = [*rows([30, 31, 30.5, 12, 30.2, 29.8, 47]), Row("z", "failed", 1, fault="x")]
    assert [r.name for r in ranked(table)] == ["z", "c3", "c6", "c0", "c1", "c2", "c4", "c5"]


def test_the_verdict_comes_before_odd_figures() -> None:
    table = rows([30, 31, 30.5, 12, 30.2, 29.8, 47])
    table[5].level, table[4].level, table[6].level, table[0].level = "unusable", "usable", "usable", "good"
    assert [r.name for r in ranked([*table, Row("z", "failed", 1)])] == ["z", "c5", "c6", "c4", "c3", "c0", "c1", "c2"]


def test_the_page_shows_and_counts_verdicts(tree: Path) -> None:
    asked = request(tree)
    out = Path(asked.out)
    run_batch(asked, Scripted(out, {}, levels={"2/1_neutral": "unusable", "1/1_neutral": "good"}))
    finding = {"stage": "masks", "said": "36 <of> 40 masks are empty."}
    (out / "2/1_neutral/run.json").write_text(json.dumps({"verdict": {"level": "unusable", "findings": [finding]}}))
    run_batch(asked, Scripted(out, {}))
    page = (out / "batch/index.html").read_text()
    assert "1 unusable, 0 usable, 1 good" in page and '<td class="level unusable">unusable</td>' in page
    assert "36 &lt;of&gt; 40 masks are empty." in page and "36 <of>" not in page
    assert page.index("2/1_neutral") < page.index("1/1_neutral")
    assert "<h1>5 of 5 captures done</h1>" in page
    table = list(csv.DictReader((out / "batch/summary.csv").open()))
    assert (table[0]["verdict"], table[0]["state"], table[0]["reason"]) == ("unusable", "unusable", finding["said"])
    assert json.loads((out / "batch/summary.json").read_text())["levels"] == {"unusable": 1, "usable": 0, "good": 1}


def test_robust_score_against_its_definition() -> None:
    values = [30.0, 31, 30.5, 12, 30.2, 29.8]
    found = {r.name: r.odd for r in ranked(rows(values))}
    # median 30.1; deviations .1 .9 .4 18.1 .1 .3 -> median .35
    assert found["c3"] == pytest.approx(0.6745 * 18.1 / 0.35, abs=0.01)
    assert found["c1"] == pytest.approx(0.6745 * 0.9 / 0.35, abs=0.01)


def test_equal_figures_and_few_of_them_are_never_odd() -> None:
    assert all(r.odd < ODD for r in ranked(rows([30.0] * 9 + [30.01])))
    assert all(r.odd == 0 for r in ranked(rows([1.0, 1.0, 99.0])))


def test_the_page_escapes_and_links(tree: Path) -> None:
    evil = Failure(kind="capture", message="<script>alert(1)</script> in a.jpg")
    out = tree.parent / "out"
    for name in ("asset/thumbnails/default.png", "report/index.html"):
        (out / "1/1_neutral" / name).parent.mkdir(parents=True)
        (out / "1/1_neutral" / name).write_bytes(b"x")
    go(tree, {"2/1_neutral": [evil]})
    page = (out / "batch/index.html").read_text()
    assert "<script" not in page and "&lt;script&gt;" in page
    assert 'src="../1/1_neutral/asset/thumbnails/default.png"' in page
    assert 'href="../1/1_neutral/report/index.html"' in page
    assert page.index("2/1_neutral") < page.index("1/1_neutral")
    table = list(csv.DictReader((out / "batch/summary.csv").open()))
    assert [r["state"] for r in table] == ["failed", "done", "done", "done", "done"]


@pytest.mark.slow
def test_a_table_of_the_whole_data_set_takes_as_much_for_each_capture(tmp_path: Path) -> None:
    """7,180 captures: the page is written every few seconds while the batch runs. Ten times the captures of another
    table may take thirty times as long on a busy machine; work that grows with their square would take a hundred."""
    asked = BatchRequest(root=str(tmp_path), out=str(tmp_path / "out"))

    def seconds(subjects: int) -> float:
        entries = [Entry(name=f"{s}/{e}", capture="/c") for s in range(subjects) for e in range(20)]
        begin = time.process_time()
        write_page(asked, Summary(entries))
        return time.process_time() - begin

    few = min(seconds(36) for _ in range(3))
    assert min(seconds(359) for _ in range(3)) < 30 * few
    assert (asked.folder / "index.html").stat().st_size < 8e6


def test_records_folder_is_the_reserved_name() -> None:
    assert BatchRequest(root="r", out="/o").folder == Path("/o") / captures.RECORDS
