"""A summary before the fit, and the early end of a run whose photos, cameras or masks are unusable.

The stages before the fit take a minute or two, the fit and what follows it many. A run ends as soon as one of the
first finds its result unusable. Finished stages stay in the store: the same command with `--force` continues.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipeline.contract import Done
from stages import registry
from workflows.run import estimate
from workflows.run.plan import Plan
from workflows.run.session import Session
from workflows.run.verdict import headline, verdict_of_done

PHOTOS_NAMED = 12  # in the line of photos to look at; run.json has all


def early_stages() -> tuple[str, ...]:
    """The stages before the fit, in order; none where there is no fit."""
    names = [s.name for s in registry.REGISTRY]
    return tuple(names[: names.index(registry.FIT)]) if registry.FIT in names else ()


def _before_fit(plan: Plan) -> tuple[str, ...]:
    """The stages before the fit in a plan, which may have those of a second capture."""
    names = [s.name for s in plan.stages]
    return tuple(names[: names.index(registry.FIT)]) if registry.FIT in names else early_stages()


def ends_early(plan: Plan, done: Sequence[Done[Any]], watch: Session) -> bool:
    """Whether the run ends early, with the stage that was just done.

    Tells the summary after the last stage before the fit, and after an earlier one where the run ends.
    """
    early, name = _before_fit(plan), done[-1].stage
    if name not in early or len(done) == len(plan.stages):
        return False
    ends = verdict_of_done(done).level == "unusable" and not plan.request.force
    if ends or name == early[-1]:
        for line in summary(plan, done, watch.elapsed()):
            watch.observer.note(line)
    return ends


def summary(plan: Plan, done: Sequence[Done[Any]], elapsed: float) -> list[str]:
    """Lines: the verdict so far, each trouble with its remedy, photos to look at, and what comes next. elapsed:
    seconds of the run so far."""
    verdict = verdict_of_done(done)
    lines = [headline(verdict.level, verdict.stages, "verdict so far")]
    lines += [f"  {reason}" for reason in verdict.reasons()]
    photos = list(dict.fromkeys(name for _, f in verdict.troubles() for name in f.views))
    if photos:
        more = f" and {len(photos) - PHOTOS_NAMED} more" if len(photos) > PHOTOS_NAMED else ""
        lines.append(f"  photos to look at or to take again: {', '.join(photos[:PHOTOS_NAMED])}{more}")
    if verdict.level == "unusable" and not plan.request.force:
        after = plan.stages[len(done)].name
        return [*lines, f"  the run ends here, before {after}; finished stages are kept: --force continues from them"]
    if verdict.level == "unusable":
        lines.append("  going on although it is unusable (--force)")
    return [*lines, f"  {estimate.remaining_time(plan, done, elapsed)}"]
