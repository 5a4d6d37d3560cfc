"""What fewer lights, cameras and harmonics cost: python -m benchmarks.reflectance_trade RUN CAPTURE

RUN: the --out of `neuface run CAPTURE`; its mesh (reflectance/mesh.npz) and motion are used, so that only the field is
fitted anew. CAPTURE: with `truth/`. A line of JSON for each case: left-out lights (those of RUN) and the environment
`soft`, over skin and eyes as in reflectance_field.py, processor seconds of samples and fit, and size of the data.
Lights and cameras are dropped so that the others stay spread: each time the one that is farthest from those taken is
added. The lights that are left out are the same in every case.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.reflectance_field import GAIN, environments, labels_of, placed, rig_of_run
from pipeline import meshes
from pipeline.ray_casting import RayCaster
from pipeline.transforms import F64, matrix
from stages.reflectance.build import fitted_field
from stages.reflectance.config import Config
from stages.reflectance.field import Field, save
from stages.reflectance.openpbr import OpenPbr
from stages.reflectance.rig import Rig
from stages.reflectance.score import decibels, score
from stages.reflectance.texels import pairs_of, points_of

SIZE, ORDER = 256, 3
LIGHTS, CAMERAS, ORDERS = (36, 18, 9), (4, 2), (0, 1, 2, 4)


def spread(directions: F64, count: int) -> list[int]:
    """`count` of the unit directions (N, 3), the first and then each time the farthest from those taken; ascending."""
    taken = [0]
    while len(taken) < min(count, len(directions)):
        taken.append(int((directions @ directions[taken].T).max(1).argmin()))
    return sorted(taken)


def cases(rig: Rig, fitted: list[int]) -> Iterator[tuple[str, list[int], list[int], int]]:
    """Name, places of lights and of cameras, order of the harmonics."""
    every = list(range(len(rig.cameras)))
    axes = np.array([matrix(c.world_from_cam)[:3, 2] for c in rig.cameras])
    yield "all", fitted, every, ORDER
    for n in LIGHTS:
        yield f"{n} lights", [fitted[i] for i in spread(rig.towards[fitted], n)], every, ORDER
    for n in CAMERAS:
        yield f"{n} cameras", fitted, spread(axes, n), ORDER
    for order in ORDERS:
        yield f"K = {(order + 1) ** 2}", fitted, every, order


def part(rig: Rig, lights: list[int], cameras: list[int]) -> Rig:
    """The rig of some lights and cameras."""
    small = rig.without([i for i in range(len(rig.index)) if i not in lights])
    return replace(small, cameras=tuple(rig.cameras[c] for c in cameras))


def fit(run: Path, small: Rig, pictures: dict, order: int, size: int) -> tuple[Field, float]:
    """The field, and the processor seconds of samples and fit."""
    path = run / "reflectance/mesh.npz"
    mesh, charts = meshes.load(path), meshes.load_charts(path)
    points = points_of(mesh, charts, size)
    pairs = pairs_of(points, small.cameras, RayCaster(mesh.vertices, mesh.faces))
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        field, _ = fitted_field(mesh, charts, points, pairs, small, pictures, Config(size=size, order=order),
                                Path(scratch), lambda: None, lambda d, n, m: None)  # fmt: skip
    return field, time.process_time() - begin


def megabytes(paths: list[Path]) -> float:
    """Of files on disk."""
    return round(sum(p.stat().st_size for p in paths) / 1e6, 1)


def main() -> None:
    """Print a line of JSON for each case."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path)
    p.add_argument("capture", type=Path)
    p.add_argument("--size", type=int, default=SIZE, help="texels along a side of the maps")
    p.add_argument("--only", action="append", help="names of cases")
    options = p.parse_args()
    basis = json.loads((options.run / "reflectance/basis.json").read_text())
    rig = rig_of_run(options.run, options.capture, basis)
    place, single = placed(rig, options.capture)
    fitted, held = [place[n] for n in basis["lights"]], [place[n] for n in basis["left_out"]]
    mask = {c: labels_of(options.capture, rig.cameras[c].index) > 0 for c in range(len(rig.cameras))}
    for name, lights, cameras, order in cases(rig, fitted):
        if options.only and name not in options.only:
            continue
        used = {(cameras.index(c), lights.index(i)): path for (c, i), path in single.items()
                if c in cameras and i in lights}  # fmt: skip
        field, seconds = fit(options.run, part(rig, lights, cameras), used, order, options.size)
        with tempfile.TemporaryDirectory() as folder:
            files = [Path(folder) / n for n in save(field, Path(folder), {})]
            size = megabytes(files)
        wanted = [(c, i) for i in held for c in range(len(rig.cameras))]
        found = score(field, rig, single, lights, wanted, GAIN, lambda d, n: None, mask, OpenPbr.of(field))
        taken = [s for s in found if s.camera in cameras]
        soft = environments(field, options.run, options.capture, rig, None, quick=True)
        print(json.dumps({
            "case": name, "left-out lights": decibels([s.field for s in found]),
            "its cameras": decibels([s.field for s in taken]), "blend": decibels([s.blend for s in taken]),
            "openpbr": decibels([s.standard for s in taken]),
            "angle": round(float(np.mean([s.angle for s in taken])), 1),
            "soft": [row["field"] for row in soft.values()], "seconds": round(seconds, 1),
            "pictures": len(used), "pictures MB": megabytes(list(used.values())), "field MB": size,
        }), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
