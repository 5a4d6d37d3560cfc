"""What a run shows while it goes on: percentages that never fall, the remaining time, lines, and JSON events."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import Located
from pipeline.capture_artifacts import Capture
from pipeline.contract import Done
from tests.support.recorded_run import RECORDED, TAKEN, Event
from workflows.cli.console import Console, clock_time
from workflows.cli.main import main
from workflows.run.forecast import Forecast, in_words
from workflows.run.phases import SHARES, Parts, part_of

ROOT = Path(__file__).resolve().parents[2]
END = RECORDED[-1].time
# Where the remaining time is compared with the truth. Not the fit: halfway, other work on the machine made its steps
# twenty times slower, which nothing can foresee.
STEADY = RECORDED[: 1 + next(i for i, e in enumerate(RECORDED) if (e.what, e.stage) == ("finished", "masks"))]
WITHIN = 0.4  # of the truth, from the middle of a run on
LEAST = 5.0  # seconds: an error that nobody minds


class Clock:
    """Seconds that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self) -> bool:
        return True


def tell(target: Console, event: Event) -> None:
    """One event of the recorded run."""
    if event.what == "started":
        target.started(event.stage, 1 + list(TAKEN).index(event.stage), len(TAKEN))
    elif event.what == "finished":
        target.finished(finished(event.stage))
    else:
        target.progress(event.done, event.total, event.message)


def finished(stage: str, *warnings: str) -> Done[Any]:
    artifact = Capture(kind="photos", views=(), warnings=warnings)
    return Done(stage, stage, Located(artifact, Path()), False, {"seconds": 2.0})


def replayed(
    expected: dict[str, float | None], slower: float = 1.0, events: Sequence[Event] = RECORDED
) -> Iterator[tuple[float, str, Forecast, float | None]]:
    """(time, stage, forecast, remaining) after each recorded event, on a machine that is so many times slower."""
    forecast = Forecast(expected, 0.0)
    for event in events:
        now = event.time * slower
        if event.what == "started":
            forecast.started(event.stage, now)
        elif event.what == "finished":
            forecast.finished(event.stage, now, reused=False)
        else:
            forecast.progress(event.done, event.total, event.message, now)
        yield now, event.stage, forecast, forecast.remaining(now)


# ------------------------------------------------------------------ the forecast
@pytest.mark.parametrize("slower", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("known", [True, False])
def test_percentages_never_fall(slower: float, known: bool) -> None:
    run, stage, name = 0.0, 0.0, ""
    for now, of, forecast, _ in replayed({n: s if known else None for n, s in TAKEN.items()}, slower):
        assert forecast.share_of_run(now) >= run and 0 <= forecast.stage_share <= 1
        if of == name and of not in forecast._finished:
            assert forecast.stage_share >= stage
        run, stage, name = forecast.share_of_run(now), forecast.stage_share, of
    assert run == 1.0


@pytest.mark.parametrize("slower", [0.5, 1.0, 2.0])
def test_the_remaining_time_is_near_the_truth_from_the_middle_on(slower: float) -> None:
    """Also where the machine is half or twice as fast as expected."""
    expected: dict[str, float | None] = {e.stage: TAKEN[e.stage] for e in STEADY}
    end, compared = STEADY[-1].time * slower, 0
    for now, _, _, remaining in replayed(expected, slower, STEADY):
        truth = end - now
        if now >= end / 2:
            assert remaining is not None
            assert abs(remaining - truth) <= max(WITHIN * truth, LEAST), now
            compared += 1
    assert compared >= 5


def test_the_time_that_passes_between_two_events_counts() -> None:
    forecast = Forecast({"first": 100.0, "second": 50.0}, 0.0)
    forecast.started("first", 0.0)
    assert forecast.remaining(0.0) == pytest.approx(150.0)
    assert forecast.remaining(40.0) == pytest.approx(110.0)
    late = forecast.remaining(300.0)
    assert late is not None and late > 50.0  # three times slower than expected: so will be the rest


def test_from_half_of_a_stage_on_its_own_pace_tells_its_end() -> None:
    """Twice as slow as expected; at a quarter both count the same."""
    forecast = Forecast({"first": 100.0}, 0.0)
    forecast.started("first", 0.0)
    forecast.progress(25, 90, "working", 50.0)
    pace = (30 + 50) / (30 + 25)
    assert forecast.remaining(50.0) == pytest.approx(0.75 * (0.5 * 100 * pace + 0.5 * 200))
    forecast.progress(50, 90, "working", 100.0)
    assert forecast.remaining(100.0) == pytest.approx(100.0)


def test_nothing_is_said_where_nothing_is_known() -> None:
    forecast = Forecast({"first": None, "second": 50.0}, 0.0)
    forecast.started("first", 0.0)
    assert forecast.remaining(5.0) is None
    forecast.progress(45, 90, "working", 10.0)
    assert forecast.remaining(10.0) == pytest.approx(50.0 * forecast._pace(10.0) + 10.0 / 0.45 * 0.55)


def test_a_budget_is_the_expected_end() -> None:
    forecast = Forecast({"first": 100.0}, 10.0, deadline=600.0)
    assert forecast.remaining(110.0) == 500.0
    assert forecast.remaining(900.0) == 0.0


def test_parts_of_a_stage_follow_one_another() -> None:
    parts = Parts({"reading": (0.0, 0.2), "fitting": (0.2, 0.9)})
    told = [(5, 10, "reading photo 5"), (10, 10, "reading photo 10"), (0, 100, "fitting"), (50, 100, "fitting")]
    assert [parts.tell(*t) for t in told] == pytest.approx([0.1, 0.2, 0.2, 0.55])
    assert parts.tell(0, 10, "something new") == pytest.approx(0.55)
    assert parts.tell(10, 10, "something new") == pytest.approx(0.775)  # half of what was left
    assert parts.tell(1, 0, "reading") == pytest.approx(0.775)
    assert part_of("photo 3 of 40") == part_of("photo 4 of 40") == "photo of"


def test_the_parts_that_have_a_share_are_told_by_their_stage() -> None:
    for stage, shares in SHARES.items():
        code = "\n".join(p.read_text() for p in (ROOT / "stages" / stage).rglob("*.py"))
        ends = [0.0, *(end for _, end in shares.values())]
        for message, (begin, end) in shares.items():
            assert f'"{message}' in code, (stage, message)
            assert 0 <= begin <= end <= 1 and begin in ends


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(1, "5 s"), (31, "30 s"), (58, "1 min"), (190, "3 min 10 s"), (700, "12 min"), (3900, "1 h 5 min")],
)
def test_times_in_words(seconds: float, text: str) -> None:
    assert in_words(seconds) == text


# ------------------------------------------------------------------ what is shown
def test_lines_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    clock, stream = Clock(), Terminal()
    console = Console(stream, clock)
    console.expect({"first": 10.0, "second": 30.0})
    console.started("first", 1, 2)
    console.finished(finished("first", "two photos are blurred"))
    console.started("second", 2, 2)
    clock.now = 65.0
    console.progress(5, 10, "working", loss=0.5)
    assert console.screen is not None
    stage, run, warning = console.screen.shown
    assert stage.startswith("[2/2] second") and " 45 % " in stage and stage.endswith("working loss 0.5")
    assert run.startswith("run: ") and "1 of 2 stages, 1:05, about " in run and run.endswith(" left")
    assert warning == "last warning: first: two photos are blurred"
    console.note("said in between")
    assert console.screen.shown == (stage, run, warning)
    assert stream.getvalue().endswith(f"said in between\n{stage}\n{run}\n{warning}")
    console.close()
    assert console.screen.shown == () and stream.getvalue().endswith("\r\x1b[2A\x1b[J")


def test_no_line_is_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "40")
    console = Console(Terminal(), Clock())
    console.expect({"first": 10.0})
    console.started("first", 1, 1)
    assert console.screen is not None and all(len(line) < 40 for line in console.screen.shown)


@pytest.mark.parametrize("term", ["dumb", ""])
def test_a_terminal_that_moves_no_cursor_gets_plain_lines(term: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", term)
    assert Console(Terminal()).screen is None


def test_plain_lines_in_a_pipe() -> None:
    clock, stream = Clock(), io.StringIO()
    console = Console(stream, clock)
    console.expect(dict(TAKEN))
    for event in RECORDED:
        clock.now = event.time
        tell(console, event)
    lines = stream.getvalue().splitlines()
    assert "\x1b" not in stream.getvalue() and "\r" not in stream.getvalue()
    shares = [int(line.rpartition("; run ")[2].partition(" %")[0]) for line in lines if "; run " in line]
    assert len(shares) >= 3 and shares == sorted(shares)
    assert sum(line.endswith(": 2.0 s") for line in lines) == len(TAKEN)


def test_json_events_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, stream, people = Clock(), io.StringIO(), io.StringIO()
    console = Console(people, clock)
    console.to_json(stream)
    console.expect(dict(TAKEN))
    for event in RECORDED:
        clock.now = event.time
        tell(console, event)
    console.finished(finished("more", "a warning"))
    events = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert people.getvalue() == ""
    assert [e["stage"] for e in events if e["event"] == "started"] == list(TAKEN)
    shown = [e["percent"] for e in events if "percent" in e]
    assert shown == sorted(shown) and shown[-1] == 100
    times = [e["time"] for e in events]
    assert times == sorted(times) and times[-1] == END
    assert events[-1] == {"event": "warning", "time": END, "stage": "more", "text": "a warning"}


@pytest.mark.usefixtures("toys")
def test_a_run_for_programs(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = photos.parent / "out"
    assert main(["run", str(photos), "--out", str(out), "--json", "--set", "first.level=usable"]) == 0
    text = capsys.readouterr()
    events = [json.loads(line) for line in text.out.splitlines()]
    assert text.err == ""
    assert [e["stage"] for e in events if e["event"] == "finished"] == ["first", "second", "third"]
    last = events[-1]
    assert (last["event"], last["level"], last["exit_code"]) == ("verdict", "usable", 0)
    assert last["findings"][0]["stage"] == "first" and last["run"] == str(out / "run.json")
    assert main(["run", str(photos), "--out", str(out), "--json", "--set", "second.fault=stage"]) == 1
    text = capsys.readouterr()
    error = json.loads(text.out.splitlines()[-1])
    assert error["event"] == "error" and "the toy is broken" in error["text"] and error["exit_code"] == 1
    assert "the toy is broken" in text.err


def test_a_reader_that_is_gone_does_not_end_the_run() -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    console = Console(io.StringIO(), Clock())
    console.to_json(Gone())
    console.started("first", 1, 1)
    console.finished(finished("first"))


def test_elapsed_time() -> None:
    assert [clock_time(s) for s in (7, 247, 3750)] == ["0:07", "4:07", "1:02:30"]
