"""The demo capture under a light that moves with the camera, to measure what that costs.

    python -m benchmarks.moving_light_capture turntable|flash OUT [--views 40] [--size 384]

turntable: the studio of the demo stands still in the room, the head turns before the camera. flash: a soft lamp above
the lens and a tenth of the studio; without falloff, because the demo's light is distant. The rest is the demo's: same
cameras, head and truth. Then

    neuface run OUT --out RUN --holdout every:5:2
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline.demo import brdf, capture, light
from pipeline.demo.render import Camera, Scene, scene_from_mesh
from pipeline.demo.rig import rig_cameras

F64 = npt.NDArray[np.float64]
ABOVE_LENS = np.array([0.05, -0.2, -1.0])  # towards the lamp, in the camera's axes
LAMP, REST = 2.6, 0.1  # flux of the lamp; share of the studio
STEP = 0.001


def turned(camera: Camera, directions: F64) -> F64:
    """Directions of the world (N, 3) as they are while the head stands still and the camera is in front: turned about
    +Y by the camera's azimuth."""
    forward = camera.cam_from_world[2, :3]
    azimuth = np.arctan2(-forward[0], -forward[2])
    c, s = np.cos(azimuth), np.sin(azimuth)
    x, y, z = directions.T
    return np.stack([c * x - s * z, y, s * x + c * z], 1)


def lamp_coefficients(camera: Camera) -> F64:
    """A soft lamp above the lens, in the world."""
    direction = camera.cam_from_world[:3, :3].T @ (ABOVE_LENS / np.linalg.norm(ABOVE_LENS))
    degree = np.repeat(np.arange(light.DEGREE + 1), 2 * np.arange(light.DEGREE + 1) + 1)
    basis = light.real_basis(direction[None])[0] * light.kernel_bands()[degree]
    return np.asarray(LAMP * basis[:, None] * np.ones(3))


def scene_of(kind: str, scene: Scene, studio: F64, camera: Camera) -> Scene:
    """The scene as this camera sees it."""
    cells = scene.table.shape[1]
    if kind == "turntable":
        table = brdf.cube_table(lambda w: light.radiance(studio, turned(camera, w)), cells)
    else:
        total = REST * studio + lamp_coefficients(camera)
        table = brdf.cube_table(lambda w: np.maximum(light.radiance(total, w), 0), cells)
    return replace(scene, table=table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=("turntable", "flash"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--size", type=int, default=384)
    given = parser.parse_args()
    for name in ("alpha", "albedo", "normal"):
        (given.out / "truth" / name).mkdir(parents=True)
    cameras = rig_cameras(given.views, given.size, 0)
    capture._write_json(given.out / "params.json", capture.facescape_params(cameras))
    mesh = capture._head_mesh(STEP)
    capture._write_mesh(given.out / "truth" / "mesh_gt.ply", capture._head_mesh(capture._TRUTH_STEP))
    studio = light.studio_coefficients(capture.EXPOSURE)
    scene = scene_from_mesh(mesh, studio, 16, 0)
    for i, camera in enumerate(cameras):
        capture._write_view(given.out, scene_of(given.kind, scene, studio, camera), camera, i)
        print(f"photo {i + 1} of {len(cameras)}", flush=True)


if __name__ == "__main__":
    main()
