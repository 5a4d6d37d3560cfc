"""The flow: photos of a head in, an asset and its report out."""

import pipeline.threads  # noqa: F401  isort: skip  (before anything that loads torch)

from pathlib import Path
from typing import Any

from prefect import flow

from stages.presets import DEFAULT_PRESET
from workflows.adapter import as_tasks, publish_result
from workflows.folders import writable
from workflows.plan import Plan, RunRequest, make_plan
from workflows.publish import publish
from workflows.runner import run_plan
from workflows.session import current


@flow(name="capture-to-asset", flow_run_name="{capture} -> {out}", retries=0, persist_result=False)
def capture_to_asset(
    capture: str,
    out: str,
    preset: str = DEFAULT_PRESET,
    holdout: str | None = None,
    name: str | None = None,
    seed: int = 0,
    device: str = "auto",
    until: str | None = None,
    from_stage: str | None = None,
    sets: list[str] | None = None,
    config: dict[str, dict[str, Any]] | None = None,
    store: str | None = None,
) -> dict[str, Any]:
    """Run the stages on one capture and publish asset/, report/ and run.json in `out`.

    Args:
        capture: folder with the photos.
        out: folder for the results; made if it is not there.
        preset: draft, studio or film.
        holdout: views kept from the fit and used for the metrics, "every:5:2" or "names:a.jpg,b.jpg".
        name: name of the asset.
        seed: of every random draw.
        device: auto, cpu or cuda.
        until: last stage to run.
        from_stage: this stage and those after it run even if the store has their results.
        sets: single settings, "stage.key=value".
        config: settings by stage, then by key.
        store: folder of finished artifacts; OUT/.store by default.
    """
    request = RunRequest(
        capture=capture,
        out=out,
        preset=preset,
        holdout=holdout,
        name=name,
        seed=seed,
        device=device,
        until=until,
        from_stage=from_stage,
        sets=tuple(sets or ()),
        config=config or {},
        store=store,
    )
    prepared = current().plan
    plan: Plan = prepared if prepared is not None and prepared.request == request else make_plan(request)
    with writable(plan.out, plan.store.root):
        done = run_plan(plan, as_tasks(plan))
        record = publish(plan, done)
    publish_result(Path(out), record)
    return record
