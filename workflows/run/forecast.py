"""How far a run is and how long it still takes: from what is expected of each stage, corrected by what it did so far.

Nothing here reads a clock or a file: times are passed in, so that a test can replay a run that was recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from workflows.run.phases import Parts

TRUST = 30.0  # seconds of work after which the pace of this run counts as much as what was expected
TRUSTED_FROM = 0.5  # share of a stage from which on only its own pace tells when it ends
ALMOST = 0.99  # no more is shown before the end


@dataclass(slots=True)
class Forecast:
    """The state of one run. Times are seconds since any fixed moment.

    expected: seconds by stage, in the order of the run; None where nothing is known. begun: when the run began.
    deadline: seconds that the whole run may take (a budget), which is then what it is expected to take.
    """

    expected: Mapping[str, float | None]
    begun: float
    deadline: float | None = None
    overall: float = 0.0
    _stage: str | None = None
    _stage_began: float = 0.0
    _parts: Parts = field(default_factory=lambda: Parts({}))
    _finished: dict[str, float] = field(default_factory=dict)
    _reused: set[str] = field(default_factory=set)

    def started(self, stage: str, now: float) -> None:
        """A stage begins."""
        self._stage, self._stage_began, self._parts = stage, now, Parts.of(stage)

    def progress(self, done: int, total: int, message: str, now: float) -> None:
        """The stage at work tells how far it is."""
        self._parts.tell(done, total, message)
        self.share_of_run(now)

    def finished(self, stage: str, now: float, *, reused: bool) -> None:
        """A stage is done."""
        self._finished[stage] = now - self._stage_began if stage == self._stage else 0.0
        if reused:
            self._reused.add(stage)
        self._stage, self._parts = None, Parts({})
        self.share_of_run(now)

    @property
    def stages_done(self) -> int:
        """How many stages are done."""
        return len(self._finished)

    @property
    def stage_share(self) -> float:
        """Of the stage at work, 0..1; it never falls while the stage runs."""
        return self._parts.share

    def share_of_run(self, now: float) -> float:
        """Of the whole run, 0..1; it never falls. Of its time, where that is known; else of its stages."""
        ended = len(self._finished) >= len(self.expected)
        rest, elapsed = self.remaining(now), now - self.begun
        if ended:
            share = 1.0
        elif rest is None:
            share = (len(self._finished) + self._parts.share) / len(self.expected)
        else:
            share = elapsed / max(elapsed + rest, 1e-9)
        self.overall = max(self.overall, share if ended else min(share, ALMOST))
        return self.overall

    def remaining(self, now: float) -> float | None:
        """Seconds until the end; None while nothing is known of a stage to come."""
        if self.deadline is not None:
            return max(0.0, self.deadline - (now - self.begun))
        pace = self._pace(now)
        rest = self._rest_of_stage(now, pace)
        for stage, seconds in self.expected.items():
            if stage in self._finished or stage == self._stage:
                continue
            if seconds is None or rest is None:
                return None
            rest += seconds * pace
        return rest

    def _pace(self, now: float) -> float:
        """Seconds that this run takes for each expected one. 1 at first; the pace so far after some TRUST seconds."""
        taken = wanted = TRUST
        for stage, seconds in self._finished.items():
            expected = self.expected.get(stage)
            if expected is not None and stage not in self._reused:
                taken, wanted = taken + seconds, wanted + expected
        expected = self.expected.get(self._stage or "")
        if expected is not None:
            elapsed, share = now - self._stage_began, self._parts.share
            taken, wanted = taken + elapsed, wanted + min(expected, share * expected if share > 0 else elapsed)
        return taken / wanted

    def _rest_of_stage(self, now: float, pace: float) -> float | None:
        """Seconds that the stage at work still takes; None if nothing is known of it and it told nothing yet."""
        if self._stage is None:
            return 0.0
        elapsed, share = now - self._stage_began, self._parts.share
        expected = self.expected.get(self._stage)
        by_progress = elapsed / share if share > 0 else None
        if expected is None:
            return by_progress * (1 - share) if by_progress is not None else None
        if by_progress is None:
            return max(expected * pace - elapsed, 0.0)
        trust = min(1.0, share / TRUSTED_FROM)
        return float((1 - share) * ((1 - trust) * expected * pace + trust * by_progress))


def in_words(seconds: float) -> str:
    """ "20 s", "3 min 10 s", "12 min", "1 h 5 min": as exact as an estimate can be."""
    if seconds < 55:
        return f"{max(5, 5 * round(seconds / 5))} s"
    if seconds < 300:
        whole = 10 * round(seconds / 10)
        return f"{whole // 60} min {whole % 60} s" if whole % 60 else f"{whole // 60} min"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"
