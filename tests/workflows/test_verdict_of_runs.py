"""The verdict of a run: exit codes, run.json, the end before the fit, what `neuface check` tells. With toy stages."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Done
from pipeline.verdict import Level
from stages import registry
from tests.support.toy_stages import finding
from workflows.cli.console import Console
from workflows.cli.main import main
from workflows.run import estimate
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.run.session import Session, Silent
from workflows.run.verdict import exit_code, is_refused, last_lines, level_in, level_of_state, state_name

pytestmark = pytest.mark.usefixtures("toys", "fit")


@pytest.fixture
def fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third toy takes the fit's place: the first two are what is known early."""
    monkeypatch.setattr(registry, "FIT", "third")


class Notes(Silent):
    """Keeps what a run notes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def paused(self, waits: bool) -> None: ...
    def note(self, text: str) -> None:
        self.lines.append(text)


def judged(*levels: tuple[str, Level]) -> tuple[str, ...]:
    return tuple(f"{stage}.level={level}" for stage, level in levels)


def run(photos: Path, *levels: tuple[str, Level], **changes: Any) -> tuple[list[Done[Any]], dict[str, Any], list[str]]:
    """What was done, run.json, and the notes."""
    request = RunRequest(capture=str(photos), out=str(photos.parent / "out"), sets=judged(*levels), **changes)
    plan, notes = make_plan(request), Notes()
    plan.out.mkdir(exist_ok=True)
    done = run_stages(plan, Session(notes))
    publish(plan, done)
    return done, json.loads((plan.out / "run.json").read_text()), notes.lines


# ------------------------------------------------------------------ run.json and exit codes
def test_the_worst_stage_is_the_verdict_and_good_findings_are_not_listed(photos: Path) -> None:
    _, record, _ = run(photos, ("first", "good"), ("second", "usable"), ("third", "unusable"))
    verdict = record["verdict"]
    assert verdict["level"] == "unusable"
    assert verdict["stages"] == {"first": "good", "second": "usable", "third": "unusable"}
    assert [(f["stage"], f["level"]) for f in verdict["findings"]] == [("third", "unusable"), ("second", "usable")]
    assert verdict["findings"][0] == {"stage": "third", **finding("unusable").model_dump(mode="json")}


@pytest.mark.parametrize(
    ("level", "strict", "code"),
    [("good", False, 0), ("good", True, 0), ("usable", False, 0), ("usable", True, 3), ("unusable", False, 3),
     ("unusable", True, 3)],
)  # fmt: skip
def test_exit_codes(photos: Path, level: Level, strict: bool, code: int) -> None:
    done, record, _ = run(photos, ("third", level), strict=strict)
    assert len(done) == 3  # a result that comes after the fit is written, whatever it is
    assert exit_code(record) == code
    assert is_refused(level_in(record), strict) == (code == 3)


def test_strict_makes_nothing_anew(photos: Path) -> None:
    run(photos, ("third", "usable"))
    done, record, _ = run(photos, ("third", "usable"), strict=True)
    assert [d.reused for d in done] == [True] * 3 and exit_code(record) == 3


@pytest.mark.parametrize("record", [{}, {"verdict": None}, {"verdict": {"level": "splendid"}}, {"stages": {}}])
def test_records_without_a_verdict_are_no_failure(record: dict[str, Any]) -> None:
    assert level_in(record) is None and exit_code(record) == 0


def test_the_last_lines_say_what_is_wrong_in_which_stage(photos: Path) -> None:
    _, record, _ = run(photos, ("first", "usable"), ("third", "unusable"))
    lines = last_lines(record)
    assert lines[0] == "verdict: unusable (third unusable; first usable; the other 1 good)"
    assert lines[1].strip() == (
        "third: unusable: 20 % of the toys are whole (a.jpg, b.jpg). What to do: take the broken toys again."
    )
    many = {**record, "verdict": {**record["verdict"], "findings": record["verdict"]["findings"] * 4}}
    assert len(last_lines(many)) == 7 and last_lines(many)[-1].strip() == "and 3 more: see run.json"
    assert last_lines(run(photos)[1]) == ["verdict: good"]
    assert last_lines({}) == []


@pytest.mark.parametrize("level", ["good", "usable", "unusable"])
def test_a_server_shows_the_level_as_the_states_name(level: Level) -> None:
    assert level_of_state(state_name(level) or "Completed") == level


# ------------------------------------------------------------------ the end before the fit
def test_an_unusable_early_stage_ends_the_run_without_an_asset_and_nothing_is_lost(photos: Path) -> None:
    done, record, notes = run(photos, ("second", "unusable"))
    assert [d.stage for d in done] == ["first", "second"]
    assert "asset" not in record and list(record["stages"]) == ["first", "second"]
    assert record["verdict"]["level"] == "unusable" and exit_code(record) == 3
    text = "\n".join(notes)
    assert "20 % of the toys are whole (a.jpg, b.jpg). What to do: take the broken toys again." in text
    assert "photos to look at or to take again: a.jpg, b.jpg" in text
    assert "the run ends here, before third" in text and "--force continues" in text
    done, record, notes = run(photos, ("second", "unusable"), force=True)
    assert [d.reused for d in done] == [True, True, False]
    assert exit_code(record) == 3  # forced, and still unusable
    assert any("--force" in line for line in notes) and not any("ends here" in line for line in notes)


def test_the_first_unusable_stage_ends_it(photos: Path) -> None:
    done, _, notes = run(photos, ("first", "unusable"))
    assert [d.stage for d in done] == ["first"]
    assert "before second" in notes[-1]


@pytest.mark.parametrize("level", ["good", "usable"])
def test_what_is_not_unusable_goes_on_after_one_summary(photos: Path, level: Level) -> None:
    done, _, notes = run(photos, ("first", level))
    assert len(done) == 3
    assert sum("verdict so far" in line for line in notes) == 1
    assert any(f"verdict so far: {level}" in line for line in notes)
    assert any("the rest (third)" in line for line in notes)


def test_until_an_early_stage_tells_no_rest_and_ends_as_asked(photos: Path) -> None:
    done, record, notes = run(photos, ("second", "unusable"), until="second")
    assert len(done) == 2 and notes == [] and exit_code(record) == 3
    done, _, notes = run(photos, ("first", "unusable"), until="second")
    assert len(done) == 1 and "before second" in notes[-1]


def test_without_a_fit_in_the_pipeline_nothing_is_early(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "FIT", "none of these")
    done, record, notes = run(photos, ("first", "unusable"))
    assert len(done) == 3 and notes == [] and exit_code(record) == 3


# ------------------------------------------------------------------ the time of the rest
def rest(photos: Path, **changes: Any) -> str:
    return next(line.strip() for line in run(photos, **changes)[2] if "the rest" in line)


def test_the_rest_is_estimated_from_earlier_runs_with_the_same_settings(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(estimate.SECONDS, "draft", {"third": 240.0})
    assert rest(photos) == "the rest (third) takes about 4 minutes (measured on two cores)"
    assert rest(photos) == "the rest (third) is in the store already"
    for path in (photos.parent / "out/.store/third").glob("*/run.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "seconds": 700.0}))
    (photos / "c.jpg").write_bytes(b"another")
    assert rest(photos) == "the rest (third) takes about 12 minutes (earlier runs here)"
    (photos / "d.jpg").write_bytes(b"and another")
    assert rest(photos, config={"third": {"plus": 1}}).startswith("the rest (third) takes about 4 minutes (measured")
    monkeypatch.setitem(estimate.SECONDS, "draft", {})
    (photos / "e.jpg").write_bytes(b"and a last one")
    assert "no time is known" in rest(photos, config={"third": {"plus": 2}})


def test_a_budget_is_its_own_estimate(photos: Path) -> None:
    plan = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), budget=600))
    assert (
        estimate.remaining_time(plan, [], 0.0)
        == "the rest (first to third) has what is left of the budget: about 10 minutes"
    )


@pytest.mark.parametrize("preset", ["draft", "studio", "film"])
def test_the_table_has_every_stage_from_the_fit_on(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    names = [s.name for s in registry.REGISTRY]
    assert list(estimate.SECONDS[preset]) == names[names.index(registry.FIT) :]


# ------------------------------------------------------------------ check
def check(photos: Path, *options: str) -> int:
    return main(["check", str(photos), *options])


@pytest.mark.parametrize(("level", "code"), [("good", 0), ("usable", 0), ("unusable", 3)])
def test_check_judges_photos_without_cameras_by_themselves(
    photos: Path, level: Level, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check(photos, "--set", f"first.level={level}", "--set", "second.level=unusable") == code
    out = capsys.readouterr().out.splitlines()
    assert out[1].split()[:4] == ["first", "toy", "share", level]
    assert out[-1].startswith(f"verdict: {level}") and "Next: " in out[-1]
    assert any("--solve" in line for line in out)
    assert ("take the broken toys again" in "".join(out)) == (level != "good")
    assert [p.name for p in photos.parent.iterdir()] == ["photos"]  # a store for the time being only


def test_check_solves_where_asked_goes_on_after_unusable_and_writes_json(photos: Path, tmp_path: Path) -> None:
    file = tmp_path / "found.json"
    options = ["--solve", "--json", str(file), "--set", "first.level=unusable", "--set", "second.level=good"]
    assert check(photos, *options) == 3
    content = json.loads(file.read_text())
    assert (content["level"], content["solved"], content["error"]) == ("unusable", True, None)
    assert content["stages"] == {"first": "unusable", "second": "good"}
    assert [f["level"] for f in content["findings"]] == ["unusable", "good"]  # all, good ones too


def test_check_runs_on_when_cameras_were_given(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from workflows.cli import check as checking

    monkeypatch.setattr(checking, "_has_cameras", lambda done: True)
    assert check(photos, "--set", "second.level=unusable") == 3


def test_a_warning_is_shown_once_though_its_stage_is_met_twice() -> None:
    """Check runs the first stage alone, then all that comes before the fit."""
    artifact = Capture(kind="photos", views=(), warnings=("two photos are blurred",))
    stream = io.StringIO()
    console = Console(stream)
    for key, reused in (("a", False), ("a", True), ("b", False)):
        console.finished(Done("capture", key, Located(artifact, Path()), reused, {}))
    assert stream.getvalue().count("two photos are blurred") == 2
    assert stream.getvalue().count("reused") == 1


def test_check_keeps_what_it_found_where_a_store_is_named(photos: Path) -> None:
    store = photos.parent / "kept"
    assert check(photos, "--solve", "--store", str(store)) == 0
    done, *_ = run(photos, store=str(store))
    assert [d.reused for d in done] == [True, True, False]


def test_check_tells_what_it_knows_before_an_error(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--solve", "--json", "-", "--set", "first.level=usable", "--set", "second.fault=stage"]
    assert check(photos, *options) == 1
    text = capsys.readouterr()
    content = json.loads(text.out)
    assert "the toy is broken" in content["error"] and content["level"] == "usable"
    assert "the toy is broken" in text.err
    assert check(photos, *[o for o in options if o not in ("--json", "-")]) == 1
    assert "take the broken toys again" in capsys.readouterr().out


def test_check_of_photos_that_can_not_be_read_is_1(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(photos, "--set", "first.fault=stage") == 1
    assert "Traceback" not in capsys.readouterr().err


def test_has_cameras() -> None:
    from types import SimpleNamespace

    from workflows.cli.check import _has_cameras

    def done(*cameras: object) -> Any:
        views = [SimpleNamespace(camera=c) for c in cameras]
        return [SimpleNamespace(located=SimpleNamespace(artifact=SimpleNamespace(views=views)))]

    assert _has_cameras(done(None, object())) and not _has_cameras(done(None, None))
