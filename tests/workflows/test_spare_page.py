"""The report's page is kept once, in OUT or in a shared store, and a run that is repeated finds it again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pipeline.artifacts import FileRef, Located
from pipeline.asset_artifacts import Report
from pipeline.contract import Done
from stages.report.page import with_timing
from workflows.run.plan import Plan, make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.spare_page import put_page_back

pytestmark = pytest.mark.usefixtures("toys")
TEMPLATE = '<!-- timing --><!-- /timing --><script type="application/json" id="timing">{}</script>'


@pytest.fixture
def plan(photos: Path) -> Plan:
    return planned(photos)


def planned(photos: Path, **changes: Any) -> Plan:
    made = make_plan(RunRequest(capture=str(photos), out=str(photos.parent / "out"), **changes))
    made.out.mkdir(exist_ok=True)
    return made


def report(plan: Plan, page: str = "") -> Done[Any]:
    """A finished report in the plan's store."""
    folder = plan.store.folder("report", "a" * 64)
    folder.mkdir(parents=True)
    (folder / "index.html").write_text(page or with_timing(TEMPLATE, {}))
    (folder / "metrics.json").write_text("{}")
    made = Report(files=tuple(FileRef.of(folder, n) for n in ("index.html", "metrics.json")))
    (folder / "manifest.json").write_text(made.model_dump_json())
    return Done("report", "a" * 64, Located(made, folder), False, {"seconds": 2.0})


def test_the_page_is_in_out_alone_and_comes_back(plan: Plan) -> None:
    done = report(plan)
    stored = done.located.folder / "index.html"
    before = stored.read_bytes()
    publish(plan, [done])
    assert not stored.exists() and b"2.0 s" in (plan.out / "report/index.html").read_bytes()
    assert (done.located.folder / "metrics.json").is_file()
    put_page_back(plan)
    assert stored.read_bytes() == before
    assert plan.store.load("report", done.key, Report) is not None
    publish(plan, [done])
    assert not stored.exists()


def test_a_page_that_is_not_the_published_one_is_made_again(plan: Plan) -> None:
    """Edited, or removed: nothing wrong is put into the store."""
    done = report(plan)
    publish(plan, [done])
    page = plan.out / "report/index.html"
    for spoil in (lambda: page.write_text(page.read_text() + "mine"), page.unlink):
        spoil()
        put_page_back(plan)
        assert not (done.located.folder / "index.html").exists()
    assert plan.store.load("report", done.key, Report) is None


def test_a_page_whose_seconds_can_not_be_taken_out_stays(plan: Plan) -> None:
    done = report(plan, with_timing(TEMPLATE, {"first": 1.0}))
    publish(plan, [done])
    assert (done.located.folder / "index.html").is_file()


@pytest.mark.parametrize("changes", [{"keep_all": True}, {"store": "shared"}])
def test_it_stays_where_it_is_asked_for_and_in_a_shared_store(
    changes: dict[str, Any], photos: Path, tmp_path: Path
) -> None:
    plan = planned(photos, **{k: str(tmp_path / v) if isinstance(v, str) else v for k, v in changes.items()})
    done = report(plan)
    publish(plan, [done])
    assert (done.located.folder / "index.html").is_file()


def test_what_is_no_result_is_left_alone(plan: Plan) -> None:
    put_page_back(plan)  # no store yet
    done = report(plan)
    publish(plan, [done])
    broken = plan.store.folder("report", "b" * 64)
    broken.mkdir()
    (broken / "manifest.json").write_text("{")
    put_page_back(plan)
    assert sorted(p.name for p in broken.iterdir()) == ["manifest.json"]
    assert (done.located.folder / "index.html").is_file()
