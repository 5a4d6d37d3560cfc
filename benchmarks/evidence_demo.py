"""The demo's head as a capture that tells more: polarised pairs, or exposure brackets. What they bring to the material.

    python -m benchmarks.evidence_demo FOLDER pairs|brackets [VIEWS SIZE]

Head, skin, light and cameras are those of `neuface demo`. pairs: FOLDER has the cross-polarised photos and
FOLDER/parallel the others. brackets: photos at OVER times the demo's exposure, which clip the bright skin, and of each
view two more, a quarter of its exposure and four times as much; all with the noise of a sensor of ELECTRONS electrons.
Then

    neuface run FOLDER --out OUT --holdout every:5:2 --keep-all [--set capture.brackets=off]
    python -m benchmarks.material OUT FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt

VIEWS, SIZE = 40, 384  # as `neuface demo`
OVER, STOPS, ELECTRONS = 3.0, (-2, 2), 5000
SAMPLES, STEP = 16, 0.001

F64 = npt.NDArray[np.float64]


def noisy(radiance: F64, rng: np.random.Generator) -> F64:
    """Linear values of a sensor that is full at 1."""
    return np.asarray(rng.poisson(ELECTRONS * radiance.clip(0, 4)) / ELECTRONS, np.float64)


def write_brackets(folder: Path, views: int, size: int) -> None:
    """The demo's capture with three exposures a view."""
    from pipeline.demo import capture, light
    from pipeline.demo.capture import srgb_from_linear, write_demo_capture
    from pipeline.demo.render import render, scene_from_mesh
    from pipeline.demo.rig import rig_cameras

    write_demo_capture(folder, views=views, size=size, samples=SAMPLES, mesh_step=STEP)
    coefficients = light.studio_coefficients(capture.EXPOSURE)
    scene = scene_from_mesh(capture._head_mesh(STEP), coefficients, SAMPLES, 0)
    (folder / "exposures").mkdir()
    listed = {}
    for i, camera in enumerate(rig_cameras(views, size, 0)):
        radiance, rng = OVER * render(scene, camera, i).radiance, np.random.default_rng(i)
        names = [f"{i}.png", *(f"exposures/{i}_{s:+d}.png" for s in STOPS)]
        for name, stops in zip(names, (0, *STOPS), strict=True):
            photo = srgb_from_linear(noisy(radiance * 2.0**stops, rng))
            capture._write_png(folder / name, photo[..., ::-1])
        listed[str(i)] = {"photos": names, "seconds": [0.01 * 2.0**s for s in (0, *STOPS)]}
    (folder / "brackets.json").write_text(json.dumps(listed))


def main() -> None:
    """See the module."""
    from pipeline.demo.capture import write_demo_capture

    folder, kind = Path(sys.argv[1]), sys.argv[2]
    views, size = (int(a) for a in sys.argv[3:5]) if len(sys.argv) > 4 else (VIEWS, SIZE)
    if kind == "brackets":
        write_brackets(folder, views, size)
    else:
        write_demo_capture(folder, views=views, size=size, samples=SAMPLES, mesh_step=STEP, polarised=True)


if __name__ == "__main__":
    main()
