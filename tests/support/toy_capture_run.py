"""Stands in for `neuface run` where a bench is tested: ends as the capture's name and the files in it say.

broken...   exit 1 with an error; bad...   exit 3 with a verdict; else exit 0
files: fail   as broken; hang   never ends; terminate   SIGTERM to the parent, then as hang; better   1 dB more
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path


def write_run(out: Path, store: Path, better: float, bad: bool) -> None:
    """run.json, metrics.json and the manifests that figures are read from."""
    manifests = {
        "capture": {"views": [{"name": f"{i}.jpg"} for i in range(4)]},
        "poses": {"cameras": [{"name": f"{i}.jpg"} for i in range(3)]},
        "masks": {"masks": [{"hull_iou": v} for v in (0.8, 0.9, None, 0.95)]},
    }
    for stage, manifest in manifests.items():
        (store / stage / "k").mkdir(parents=True, exist_ok=True)
        (store / stage / "k" / "manifest.json").write_text(json.dumps(manifest))
    for stage, manifest in (("uv", {"charts": 12}), ("bake", {"figures": {"unseen": 0.25}})):
        (store / stage / "k").mkdir(parents=True, exist_ok=True)
        (store / stage / "k" / "manifest.json").write_text(json.dumps(manifest))
    findings = [
        {"stage": "poses", "check": "placed", "level": "good", "said": "all photos have a camera"},
        {"stage": "uv", "check": "charts", "level": "usable", "said": "many charts"},
        {"stage": "masks", "check": "agreement", "level": "unusable", "said": "the masks do not agree"},
    ]
    record = {
        "store": str(store),
        "stages": {s: {"key": "k", "peak_memory_mb": 100.0} for s in (*manifests, "uv", "bake")},
        "timing": {"capture": 2.0, "total": 2.0},
        "verdict": {"level": "unusable" if bad else "good", "findings": findings if bad else findings[:1]},
    }
    held = {"views": 2, "held_out": True, "psnr": 19.5, "psnr_matched": 19.6, "asset_psnr": 20.0 + better,
            "asset_psnr_matched": 20.1, "features_px": 0.62, "features_px_most": 1.4}  # fmt: skip
    (out / "report").mkdir(exist_ok=True)
    (out / "report" / "metrics.json").write_text(json.dumps({"holdout": held}))
    (out / "run.json").write_text(json.dumps(record))


def main() -> int:
    """As `neuface` would be called."""
    arguments = sys.argv[1:]
    given = dict(zip(arguments[2::2], arguments[3::2], strict=True))
    capture, out = Path(arguments[1]), Path(given["--out"])
    out.mkdir(parents=True, exist_ok=True)
    (out / "asked.json").write_text(json.dumps(arguments))
    (out / "pid").write_text(str(os.getpid()))
    print("[1/9] capture: 1.5 s\n[2/9] poses: reused", file=sys.stderr, flush=True)
    if (capture / "terminate").exists():
        os.kill(os.getppid(), signal.SIGTERM)
    if (capture / "hang").exists() or (capture / "terminate").exists():
        time.sleep(600)
    if out.name.startswith("broken") or (capture / "fail").exists():
        print(f"error: the toy is broken\n  where: here\n  found: {capture}/7\n  limit: 4", file=sys.stderr)
        return 1
    if (capture / "early").exists():
        return 3
    bad = out.name.startswith("bad")
    write_run(out, Path(given["--store"]) / out.name, float((capture / "better").exists()), bad)
    return 3 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
