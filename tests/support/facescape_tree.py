"""A tree in FaceScape's layout, as small as the capture stage takes it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.demo.capture import write_demo_capture


def write_tree(root: Path, captures: dict[str, bool], side: int = 64) -> None:
    """FaceScape's layout: ID/EXPRESSION/params.json and three photos; False: one photo is cut off."""
    for number, (name, whole) in enumerate(captures.items()):
        folder = root / name
        folder.mkdir(parents=True)
        params: dict[str, Any] = {}
        for view in range(3):
            rng = np.random.default_rng([number, view])
            picture = cv2.resize(rng.integers(0, 255, (8, 8, 3), np.uint8), (side, side))
            data = cv2.imencode(".jpg", picture)[1].tobytes()
            if view == 1 and not whole:
                data = data[: len(data) // 2]
            (folder / f"{view}.jpg").write_bytes(data)
            place = [[1.0, 0, 0, 0.1 * view], [0, 1.0, 0, 0], [0, 0, 1.0, 1.0]]
            params |= {
                f"{view}_K": [[100.0, 0, side / 2], [0, 100.0, side / 2], [0, 0, 1.0]],
                f"{view}_Rt": place,
                f"{view}_distortion": [0.0] * 5,
                f"{view}_width": side,
                f"{view}_height": side,
                f"{view}_valid": True,
                f"{view}_ori": 0,
                f"{view}_sn": "1",
            }
        (folder / "params.json").write_text(json.dumps(params))


def write_heads(root: Path, captures: dict[str, bool], side: int = 72) -> None:
    """The same layout with heads that can be fitted, nine small photos of each; False: one photo is cut off."""
    for seed, (name, whole) in enumerate(captures.items()):
        write_demo_capture(root / name, views=9, size=side, samples=4, mesh_step=0.004, seed=seed)
        photo = root / name / "1.png"
        if not whole:
            photo.write_bytes(photo.read_bytes()[: photo.stat().st_size // 2])
