"""The flow of toy_batch.py for a worker, with more points at which a test may hold it (tests/support/points.py).

"flow.import": its module is being imported; "flow.begin": Prefect calls the run running, and no stage has begun;
"STAGE.begin" and "STAGE.end"; "publish.ready": the new folders are complete beside the old ones; "publish.done".
Each result that is stored adds a line, its stage and its key, to the file $NEUFACE_STORED.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from tests.support.points import before, instrument_store, reach

reach("flow.import")

from pipeline.store import Store  # noqa: E402
from tests.support.toy_batch import capture_to_asset  # noqa: E402
from workflows import flows  # noqa: E402
from workflows.run import publish  # noqa: E402


def finished(store: Store, stage: str, key: str, *rest: Any) -> Any:
    """`Store.finish`, counted once the result is in its place."""
    made = finish(store, stage, key, *rest)
    if path := os.environ.get("NEUFACE_STORED"):
        with Path(path).open("a") as f:
            f.write(f"{stage} {key}\n")
    return made


finish = Store.finish
Store.finish = finished  # type: ignore[method-assign, assignment]
instrument_store()
flows.make_plan = before("flow.begin", flows.make_plan)
flows.publish_result = before("publish.done", flows.publish_result)
publish._stop_if = before("publish.ready", publish._stop_if)

__all__ = ["capture_to_asset"]
