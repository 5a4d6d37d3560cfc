"""`--budget`: what a time pays for, and that an interrupted run goes on with the same plan."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.artifacts import MaskSet, ViewMask
from pipeline.errors import UsageError
from pipeline.store import Store
from stages.presets import configs_for
from stages.registry import FIT
from workflows.cli.main import parser
from workflows.cli.options import request_from
from workflows.run import budget
from workflows.run.budget import DRAFT_RATE, MIN_FIT, RUNGS, BudgetPlan, choose
from workflows.run.plan import check_settings, make_plan, preview
from workflows.run.request import RunRequest
from workflows.run.runner import probably_from_template, run_stages

NAMES = [r.name for r in RUNGS]


def test_more_time_never_buys_less() -> None:
    chosen = [choose(60.0 * 1.2**i, DRAFT_RATE) for i in range(50)]
    ranks = [NAMES.index(c.rung) for c in chosen]
    assert ranks == sorted(ranks) and ranks[0] == 0 and ranks[-1] == len(RUNGS) - 1
    for lower, higher in zip(chosen, chosen[1:], strict=False):
        assert higher.rung != lower.rung or higher.seconds >= lower.seconds


def test_a_rung_is_filled_with_rays_and_all_stages_fit() -> None:
    for left in (150.0, 300.0, 600.0, 1800.0, 36_000.0):
        for pace in (DRAFT_RATE / 3, DRAFT_RATE, 20 * DRAFT_RATE):
            plan = choose(left, pace)
            rung = RUNGS[NAMES.index(plan.rung)]
            slower = DRAFT_RATE / pace
            if plan.fits:
                assert plan.seconds + slower * rung.after == pytest.approx(left, abs=0.1)
                assert (plan.seconds - slower * rung.before) * pace * rung.rate >= min(rung.rays, 1.0)


def test_the_head_templates_time_is_not_the_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rung is the same, or a smaller one; on a slow machine the template takes longer too."""
    monkeypatch.setattr(budget, "calibrate", lambda device: DRAFT_RATE / 2)
    scan, template = (
        budget.planned(Store(tmp_path), {"of": made}, 700.0, "cpu", from_template=made) for made in (False, True)
    )
    assert scan.rung == template.rung == "draft"
    assert scan.seconds - template.seconds == pytest.approx(2 * budget.TEMPLATE, abs=0.2)


def test_a_person_is_planned_with_the_template(tmp_path: Path) -> None:
    face = ViewMask.model_construct(index=0, labelled=("face",))
    people = MaskSet.model_construct(masks=(face,) * 9)
    things = MaskSet.model_construct(masks=(ViewMask.model_construct(index=0, labelled=()),) * 9)
    for sets, masks, expected in (((), people, True), ((), things, False), (("uv.mesh=scan",), people, False)):
        configs = check_settings(RunRequest(capture="c", out=str(tmp_path), budget=600.0, sets=sets), None)
        done: Any = [SimpleNamespace(located=SimpleNamespace(artifact=masks))]
        plan: Any = SimpleNamespace(configs=configs)
        assert probably_from_template(plan, done) is expected


def test_too_little_time_still_leaves_an_asset_and_is_told() -> None:
    plan = choose(5.0, DRAFT_RATE)
    assert plan.rung == "coarse" and plan.seconds == MIN_FIT + RUNGS[0].before and not plan.fits
    assert "longer than the budget" in plan.describe(5.0) and "longer" not in choose(3600.0, DRAFT_RATE).describe(
        3600.0
    )


def test_every_rung_is_valid_settings() -> None:
    for rung in RUNGS:
        configs = configs_for("draft", {}, planned=BudgetPlan(rung.name, 12.5, 1.0, True).settings())
        fit: Any = configs[FIT]
        assert fit.seconds == 12.5 and fit.image_side == rung.settings[FIT]["image_side"]
        assert configs["bake"].model_dump()["size"] == rung.settings["bake"]["size"]


def test_a_users_own_setting_wins(tmp_path: Path) -> None:
    planned = choose(1800.0, DRAFT_RATE).settings()
    request = RunRequest(capture="c", out=str(tmp_path), budget=1800.0, sets=("bake.size=512",))
    assert check_settings(request, planned)["bake"].model_dump()["size"] == 512


def test_a_plan_is_kept_for_its_purpose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paces = iter([DRAFT_RATE, 2 * DRAFT_RATE, 3 * DRAFT_RATE])
    monkeypatch.setattr(budget, "calibrate", lambda device: next(paces))
    store = Store(tmp_path)
    first = budget.planned(store, {"budget": 600, "after": ["a"]}, 500.0, "cpu")
    assert budget.planned(store, {"budget": 600, "after": ["a"]}, 20.0, "cpu") == first
    assert budget.planned(store, {"budget": 600, "after": ["b"]}, 500.0, "cpu").pace == 2 * DRAFT_RATE
    for torn in (tmp_path / budget.PLANS).iterdir():
        torn.write_text("{")
    assert budget.planned(store, {"budget": 600, "after": ["a"]}, 500.0, "cpu").pace == 3 * DRAFT_RATE


def test_budget_and_preset_exclude_each_other(photos: Path, toys: None) -> None:
    request = RunRequest(capture=str(photos), out=str(photos.parent / "out"), budget=60.0, preset="studio")
    with pytest.raises(UsageError, match="both set the size of the fit"):
        make_plan(request)


def test_the_command_line_takes_times(tmp_path: Path) -> None:
    options = parser().parse_args(["run", "c", "--out", str(tmp_path), "--budget", "10m"])
    assert request_from(options, RunRequest).budget == 600.0
    with pytest.raises(SystemExit):
        parser().parse_args(["run", "c", "--out", str(tmp_path), "--budget", "soon"])


def test_the_run_plans_before_the_fit_alone(
    photos: Path, toys: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With toy stages, the second of which plays the fit."""
    from workflows.run import plan as planning
    from workflows.run import runner

    asked: list[Any] = []

    def found(store: Store, purpose: dict[str, Any], left: float, device: str, **of: Any) -> Any:
        assert of == {"from_template": True}
        asked.append((purpose["after"], left))
        return BudgetPlan("coarse", 30.0, 1.0, True)

    monkeypatch.setattr(runner, "FIT", "second")
    monkeypatch.setattr(planning, "FIT", "second")
    monkeypatch.setattr(runner, "planned", found)
    monkeypatch.setattr(runner, "probably_from_template", lambda plan, done: True)
    monkeypatch.setattr(BudgetPlan, "settings", lambda self: {})
    monkeypatch.setattr(BudgetPlan, "describe", lambda self, budget: "planned")
    plan = make_plan(RunRequest(capture=str(photos), out=str(tmp_path / "out"), budget=60.0))
    assert [s.key is None for s in preview(plan)] == [False, True, True]
    done = run_stages(plan)
    assert asked[0][0] == [done[0].key] and 0 < asked[0][1] < 60.0 and len(asked) == 1
    assert [s.key is None for s in preview(plan)] == [False, True, True]
