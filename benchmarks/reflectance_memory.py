"""Peak memory of the reflectance stage on a made-up light stage, by size of its photos.

    python -m benchmarks.reflectance_memory FOLDER --side 2048 --cameras 3 --lights 16 --size 512

Photos are those of tests/support/light_stage.py, a ball, enlarged to `side` pixels: what is in them hardly matters for
the memory. They are made and imported by a process of its own. Prints the peak at the end of each step, and the
largest.
"""

from __future__ import annotations

import argparse
import json
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np

from pipeline.contract import peak_memory_mb

DRAWN = 256  # pixels along a side of the pictures that are enlarged


def main() -> None:
    """One case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    for name, value in (("side", 1024), ("cameras", 3), ("lights", 16), ("size", 512)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--prepare", action="store_true", help="only make and import the photos")
    asked = parser.parse_args()
    if asked.prepare:
        prepare(asked.folder, asked.side, asked.cameras, asked.lights)
        return
    kept = asked.folder / "inputs.pkl"
    if not kept.is_file():
        subprocess.run([sys.executable, "-m", "benchmarks.reflectance_memory", *sys.argv[1:], "--prepare"], check=True)
    run(kept, asked.folder / "work", asked.size)


def run(kept: Path, work: Path, size: int) -> None:
    """The stage on inputs of `prepare`."""
    import pipeline.threads  # noqa: F401
    from pipeline.contract import Context
    from stages.reflectance import stage

    inputs = pickle.loads(kept.read_bytes())
    said = ["imports"]
    print(f"{'before':40} {peak_memory_mb():8.0f} MB", flush=True)

    def progress(done: int, total: int, message: str = "", **figures: float) -> None:
        if message != said[-1]:
            print(f"{said[-1]:40} {peak_memory_mb():8.0f} MB", flush=True)
            said.append(message)

    work.mkdir(parents=True, exist_ok=True)
    stage.run(inputs, stage.Config(size=size), Context(work, work / "scratch", progress=progress))
    print(f"{said[-1]:40} {peak_memory_mb():8.0f} MB\nlargest {peak_memory_mb():.0f} MB")


def prepare(folder: Path, side: int, cameras: int, lights: int) -> None:
    """Write the capture, import it, and keep the stage's inputs as inputs.pkl."""
    import cv2

    from pipeline import meshes
    from pipeline.artifacts import Camera, CameraSet, Located, UvMesh
    from pipeline.contract import Context
    from pipeline.images import write_exr
    from pipeline.transforms import centre_K_from_corner_K, inverse_rigid, rows
    from stages.capture import stage as capture_stage
    from stages.capture.scan import scan_capture
    from stages.reflectance import stage
    from tests.support import light_stage
    from tests.support.ball_mesh import ball_mesh

    small = light_stage.K * [[DRAWN / light_stage.SIZE], [DRAWN / light_stage.SIZE], [1]]
    light_stage.K, light_stage.SIZE = small, DRAWN
    made, source = light_stage.make_stage(cameras, lights), folder / "in"
    K = small * [[side / DRAWN], [side / DRAWN], [1]]
    source.mkdir(parents=True, exist_ok=True)
    params: dict[str, object] = {}
    for c, pose in enumerate(made.poses):
        params |= {f"{c}_K": centre_K_from_corner_K(K).tolist(), f"{c}_Rt": inverse_rigid(pose)[:3].tolist(),
                   f"{c}_distortion": [0.0] * 5, f"{c}_width": side, f"{c}_height": side, f"{c}_valid": True,
                   f"{c}_sn": f"S{c}"}  # fmt: skip
        total = np.zeros((side, side, 3), np.float32)
        for n in range(lights):
            picture = cv2.resize(light_stage.photograph(made, c, n, 0.03).astype(np.float32), (side, side))
            total += picture
            write_exr(source / "olat" / str(c) / f"{n:03d}.exr", picture, half=True)
        write_exr(source / "full_on" / f"{c}.exr", total, half=True)
        for frame in (0, lights // 2):
            write_exr(source / "tracking" / str(c) / f"{frame:03d}.exr", total, half=True)
    (source / "params.json").write_text(json.dumps(params))
    light_stage.write_lights(source, made)
    work = folder / "capture"
    work.mkdir(exist_ok=True)
    read = capture_stage.run(
        capture_stage.Inputs(scan_capture(source)), capture_stage.Config(), Context(work, work / "scratch")
    )
    shots = tuple(Camera(index=i, name=str(i), width=side, height=side, K=rows(K), world_from_cam=rows(p),
                         distortion=(0,) * 5) for i, p in enumerate(made.poses))  # fmt: skip
    poses = CameraSet(source="given", metric=True, capture_from_asset=rows(np.eye(4)), roi_radius=0.15, cameras=shots)
    mesh, charts = ball_mesh()
    meshes.save(folder / "mesh.npz", mesh, charts)
    uv = UvMesh(mesh=Context(folder, folder).file("mesh.npz"), vertices=len(mesh.vertices), faces=len(mesh.faces),
                charts=1, utilisation=1, stretch=1, overlap=0, deviation_mm=0)  # fmt: skip
    inputs = stage.Inputs(Located(read, work), Located(poses, folder), Located(uv, folder))
    (folder / "inputs.pkl").write_bytes(pickle.dumps(inputs))
    print(f"photos made and imported, peak {peak_memory_mb():.0f} MB")


if __name__ == "__main__":
    main()
