"""Pictures of a field, and where its eyes glint: python -m benchmarks.reflectance_pictures RUN CAPTURE --out DIR

RUN, CAPTURE: as for reflectance_field.py. Writes single lights that were left out (truth, field, OpenPBR), three
environments, and the eyes close up under left-out lights (truth above the field). Prints how far the glints of the
field's eyes are from those of the truth, over all left-out lights seen by these cameras.

A glint is a place of an eye that is brighter than the median around it by BRIGHTER, and by half of that median.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.reflectance_field import EYE, GAIN, SOFT_GAIN, labels_of, placed, rig_of_run
from pipeline.images import F32, read_linear, write_png
from pipeline.transforms import F64
from stages.reflectance.field import Field, Lamp, load
from stages.reflectance.openpbr import OpenPbr
from stages.reflectance.relight import lit_by, look_up, picture, under_lamps
from stages.reflectance.rig import Rig
from stages.reflectance.score import camera_at, encoded
from workflows.cli.relight import environment
from workflows.cli.render import capture_from_asset_of, given_cameras

BRIGHTER, SHARE, AROUND = 0.1, 0.2, 7  # linear; of the truth's glint, for one of the field; pixels of the median
LEAST_EYE, MARGIN, CLOSE = 40, 6, 5  # pixels of an eye; around it in the close-up; magnification
ENVIRONMENTS = ("sunset", "overcast", "key")
SHOWN = (0, 2, 4)  # cameras


def predicted(field: Field, rig: Rig, camera: int, light: int) -> F32:
    """(H, W, 4) picture of a light as the camera saw it."""
    positions, axes = rig.lamps()
    lamp, view = Lamp(positions[light], axes[light], rig.strength[light]), camera_at(rig, camera, light)
    return picture(view, look_up(field, view, 3), lit_by(field, view, lamp, field.arrives(lamp)))


def brightest(single: dict, lights: list[int], camera: int) -> list[int]:
    """Lights by the mean of a camera's picture under them, the brightest first."""
    return sorted(lights, key=lambda i: -float(read_linear(single[camera, i]).mean()))


def eyes_of(label: np.ndarray) -> list[tuple[slice, slice]]:
    """Boxes of the eyes that a camera sees."""
    from scipy.ndimage import find_objects
    from scipy.ndimage import label as numbered

    parts, _ = numbered(label == EYE, np.ones((3, 3)))
    return [box for n, box in enumerate(find_objects(parts), 1) if (parts[box] == n).sum() >= LEAST_EYE]


def glint(image: F32, eye: np.ndarray) -> tuple[F64, float]:
    """Place (2,) of the brightest glint on the pixels `eye` (H, W), row and column by the centre of what is around its
    peak, and how much brighter it is than the median around."""
    from scipy.ndimage import median_filter

    grey = image[..., :3].mean(2).astype(np.float64)
    more = np.where(eye, grey - median_filter(grey, AROUND), 0)
    row, column = np.unravel_index(int(more.argmax()), more.shape)
    last = np.array(more.shape)
    box = np.mgrid[max(row - 1, 0) : min(row + 2, last[0]), max(column - 1, 0) : min(column + 2, last[1])]
    weight = np.maximum(more[box[0], box[1]], 0)
    place = (box * weight).sum((1, 2)) / max(float(weight.sum()), 1e-12)
    return np.asarray(place, np.float64), float(more[row, column])


def glints(field: Field, rig: Rig, single: dict, held: list[int], capture: Path) -> dict:
    """Distances in pixels between the glints of truth and field."""
    far, missed = [], 0
    for c in SHOWN:
        label = labels_of(capture, rig.cameras[c].index)
        boxes = eyes_of(label)
        for i in held if boxes else []:
            truth, made = read_linear(single[c, i]), predicted(field, rig, c, i)
            for box in boxes:
                eye = label[box] == EYE
                at, bright = glint(truth[box], eye)
                if bright < max(BRIGHTER, 0.5 * float(np.median(truth[box].mean(2)[eye]))):
                    continue
                own, found = glint(made[box], eye)
                missed += found < SHARE * bright
                if found >= SHARE * bright:
                    far.append(float(np.linalg.norm(at - own)))
    count = len(far) + missed
    pixels = [round(float(q), 2) for q in np.quantile(far or [0], (0.5, 0.9))]
    return {"glints": count, "missed": missed, "pixels": pixels,
            "within 1 pixel": round(sum(d <= 1 for d in far) / max(count, 1), 3)}  # fmt: skip


def close_ups(field: Field, rig: Rig, single: dict, lights: list[int], capture: Path, camera: int) -> F64:
    """Truth above the field, a column for each light, both eyes beside each other."""
    label, columns = labels_of(capture, rig.cameras[camera].index), []
    for i in lights:
        truth, made = read_linear(single[camera, i]), predicted(field, rig, camera, i)
        rows = []
        for image in (truth, made[..., :3]):
            parts = []
            for y, x in eyes_of(label)[:2]:
                cy, cx = (y.start + y.stop) // 2, (x.start + x.stop) // 2
                crop = encoded(image[cy - 12 : cy + 12, cx - 24 : cx + 24], GAIN)
                parts.append(np.kron(crop, np.ones((CLOSE, CLOSE, 1))))
            rows.append(np.hstack(parts))
        columns.append(np.vstack(rows))
    return np.hstack(columns)


def main() -> None:
    """Write the pictures and print the glints."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("run", type=Path)
    p.add_argument("capture", type=Path)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--quick", action="store_true", help="without the glints")
    options = p.parse_args()
    folder = options.run / "reflectance"
    field, basis = load(folder), json.loads((folder / "basis.json").read_text())
    rig = rig_of_run(options.run, options.capture, basis)
    place, single = placed(rig, options.capture)
    held = [place[n] for n in basis["left_out"]]
    rows = []
    standard, left = OpenPbr.of(field), list(held)
    for c in SHOWN:
        light = brightest(single, left, c)[0]
        left.remove(light)
        shown = [read_linear(single[c, light])]
        shown += [predicted(one, rig, c, light)[..., :3] for one in (field, standard)]
        rows.append(np.hstack([encoded(image, GAIN) for image in shown]))
    write_png(options.out / "reflectance_lights.png", np.vstack(rows))
    write_png(
        options.out / "reflectance_eyes.png",
        close_ups(field, rig, single, brightest(single, held, 0)[:3], options.capture, 0),
    )
    if not options.quick:
        print("glints", json.dumps(glints(field, rig, single, held, options.capture)), flush=True)
    views = [v for i, v in given_cameras(options.capture / "params.json", options.run).items() if i in (0, 2)]
    relit = []
    for name in ENVIRONMENTS:
        lamps = environment(name, capture_from_asset_of(options.run), quick=True)
        made = under_lamps(field, views, lamps, lambda d, n: None)
        relit.append([picture(v, look_up(field, v), lit)[..., :3] for v, lit in zip(views, made, strict=True)])
    top = [SOFT_GAIN * 0.8 / max(float(np.quantile(row[0].max(2), 0.98)), 1e-9) for row in relit]
    beside = [encoded(image, gain) for row, gain in zip(relit, top, strict=True) for image in row]
    write_png(options.out / "reflectance_environments.png", np.hstack(beside))


if __name__ == "__main__":
    main()
