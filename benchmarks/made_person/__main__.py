"""A woman with a bob, or with long hair, in a rig: a capture with truth, for what short hair does not show.

    python -m benchmarks.made_person OUT --kit TEMPLATE_KIT --rig CAPTURE --blender PYTHON [--look bob|long] [--alike]

TEMPLATE_KIT has MakeHuman's base.obj and targets; the cameras of CAPTURE's params.json are used; PYTHON has Blender's
module. `bob` has dark brown skin and a striped shirt, `long` light skin, fair hair and a white shirt; the backdrop is
grey. OUT is in FaceScape's format; OUT/truth is for scoring only. Without --rig the photos are those of a phone in a
room, in OUT/images. Then

    neuface run OUT --preset draft --holdout every:5:2 --out RUN
"""

from __future__ import annotations

import argparse
import json
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR

from benchmarks.made_person.figure import LOOKS, make_figure, to_world
from benchmarks.made_person.phone import developed, photos
from benchmarks.made_person.strands import brows, hair
from pipeline.colour import srgb_from_linear
from pipeline.meshes import F64

Views = dict[str, dict[str, Any]]  # of each photo: K, Rt, size and, for a phone, the motion of the head
BOXES = (((0.6, 0.75, 0.6), 0.32, 5.5), ((-0.7, 0.7, 0.4), 0.34, 4.0), ((0.1, 0.75, -0.7), 0.3, 3.2),
         ((-0.05, 0.98, 0.1), 0.25, 3.0))  # direction, half angle in radians, radiance  # fmt: skip
BACKDROP, WARM = np.array([0.33, 0.33, 0.3366]), np.array([1, 0.98, 0.95])
STRIPES = {"bob": [[0.03, 0.12, 0.10], [0.55, 0.50, 0.35]], "long": [[0.75, 0.74, 0.70], [0.70, 0.68, 0.66]]}
IRIS = {"bob": [0.06, 0.03, 0.015], "long": [0.10, 0.14, 0.10]}
MELANIN, EXPOSURE = {"bob": 0.95, "long": 0.28}, {"bob": 1.15, "long": 0.95}
GAINS = ((1.03, 1.0, 0.98), (0.97, 1.0, 1.025), (1.0, 1.03, 0.99), (0.975, 0.965, 1.0))  # of four kinds of camera
METERED = 0.2  # linear level of a phone's middle grey
SHOWN = -0.16  # height from which the skin is part of the truth, m


def studio() -> F64:
    """(256, 512, 3) lat-long radiance: four soft boxes above, a grey backdrop around."""
    theta, phi = np.meshgrid((np.arange(256) + 0.5) / 256 * np.pi, (np.arange(512) + 0.5) / 512 * 2 * np.pi,
                             indexing="ij")  # fmt: skip
    d = np.stack([np.sin(theta) * np.sin(np.pi - phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    out = BACKDROP * (1 + 0.084 * d[..., :1] + 0.1 * d[..., 1:2])
    for towards, half, radiance in BOXES:
        edge = np.cos(half) - np.cos(1.25 * half)
        cosine = d @ (np.array(towards) / np.linalg.norm(towards))
        out = out + radiance * np.clip((cosine - np.cos(1.25 * half)) / edge, 0, 1)[..., None] * WARM
    return out


def write_scene(folder: Path, kit: Path, style: str, views: Views) -> None:
    """What Blender needs, but for the light."""
    look = LOOKS[style]
    rng = np.random.default_rng(look.seed)
    figure = make_figure(kit, look, rng)
    strand, last = hair(figure, look, rng)
    rows, quads = np.unique(figure.skin, return_inverse=True)
    centres, radii = figure.eyes
    np.savez(folder / "person.npz", skin=to_world(figure.vertices[rows]), skin_quads=quads.reshape(figure.skin.shape),
             colour=figure.colour[rows], shirt=to_world(figure.shirt[0]), shirt_quads=figure.shirt[1],
             eyes=to_world(centres), eye_radii=0.1 * radii, hair=to_world(strand), hair_last=last,
             brows=to_world(brows(figure, rng)), iris=IRIS[style], stripes=STRIPES[style],
             melanin=MELANIN[style])  # fmt: skip
    (folder / "rig.json").write_text(json.dumps(views))


def rig_views(params: dict[str, object]) -> Views:
    """The views of a params.json."""
    return {
        i: {"K": params[k], "Rt": params[f"{i}_Rt"], "size": [params[f"{i}_width"], params[f"{i}_height"]]}
        for k in params
        if k.endswith("_K") and (i := k.removesuffix("_K"))
    }


def layers(path: Path) -> tuple[F64, F64, F64, np.ndarray]:
    """Radiance (H, W, 3), coverage (H, W, 1), albedo (H, W, 3) and material (H, W) of a rendered view."""
    every = {k: c for p in OpenEXR.File(str(path), separate_channels=True).parts for k, c in p.channels.items()}

    def one(end: str) -> F64:
        return next(c.pixels for k, c in every.items() if k.endswith(end)).astype(np.float64)

    colour, albedo = (np.stack([one(f"{n}.{c}") for c in "RGB"], -1) for n in ("Combined", "Diffuse Color"))
    number = np.round(one("Material Index.X")).astype(np.uint8)
    return colour, one("Combined.A")[..., None], albedo, number


def backdrop(light: F64, K: F64, R: F64, size: tuple[int, int]) -> F64:
    """(H, W, 3) the light behind the person."""
    w, h = size
    y, x = np.mgrid[:h, :w]
    d = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones((h, w))], -1) @ R
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    u = (np.arctan2(-d[..., 0], d[..., 2]) / (2 * np.pi) + 0.5) * light.shape[1] - 0.5
    v = np.arccos(d[..., 1].clip(-1, 1)) / np.pi * light.shape[0] - 0.5
    place = (u % light.shape[1]).astype(np.float32), v.astype(np.float32)
    return np.asarray(cv2.remap(light.astype(np.float32), *place, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP))


def develop(folder: Path, out: Path, views: Views, style: str, alike: bool) -> None:
    """Photos of a rig, and the truth beside them. alike: all cameras have the same colours."""
    light = np.load(folder / "light.npy").astype(np.float64)
    for i, view in views.items():
        colour, alpha, albedo, number = layers(folder / f"{i}.exr")
        behind = backdrop(light, np.array(view["K"]), np.array(view["Rt"])[:, :3], view["size"])
        rng = np.random.default_rng(5000 + int(i))
        linear = EXPOSURE[style] * (colour + (1 - alpha) * behind)
        linear *= 1 if alike else GAINS[int(i) % len(GAINS)]
        linear += rng.normal(size=linear.shape) * (0.002 + 0.004 * np.sqrt(linear.clip(0, 1)))
        write_photo(out / f"{i}.jpg", (255 * np.asarray(srgb_from_linear(linear.clip(0, 1))) + 0.5).astype(np.uint8))
        write_labels(out / "truth", i, np.where(alpha[..., 0] < 0.5, 0, number), albedo, alpha[..., 0] > 0.99)
    write_truth(folder, out, views)


def develop_phone(folder: Path, out: Path, views: Views) -> None:
    """Photos of a phone, whose exposure follows the whole scene, and the truth beside them."""
    brightness = [np.median(layers(folder / f"{i}.exr")[0].mean(-1)) for i in views]
    for i in views:
        colour, _, albedo, number = layers(folder / f"{i}.exr")
        rng = np.random.default_rng(5000 + int(i))
        write_photo(out / f"images/{i}.jpg", developed(METERED / np.median(brightness) * colour, rng))
        write_labels(out / "truth", i, number, albedo, number > 0)
    write_truth(folder, out, views)


def write_photo(path: Path, pixels: np.ndarray) -> None:
    """As JPEG."""
    cv2.imwrite(str(path), pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])


def write_labels(folder: Path, view: str, number: np.ndarray, albedo: F64, whole: np.ndarray) -> None:
    """The materials of a photo, and of every fourth the albedo."""
    cv2.imwrite(str(folder / f"labels/{view}.png"), number.astype(np.uint8))
    if int(view) % 4 == 0:
        write_albedo(folder / f"albedo/{view}.exr", albedo, (number == 1) & whole)


def write_albedo(path: Path, albedo: F64, skin: np.ndarray) -> None:
    """Half size: albedo of the skin, and the share of each pixel that is skin."""
    h, w = skin.shape
    share = skin.reshape(h // 2, 2, w // 2, 2).mean((1, 3))[..., None]
    total = (albedo * skin[..., None]).reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))
    pixels = np.concatenate([total / np.maximum(share, 1e-6), share], -1).astype(np.float16)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, {"RGBA": pixels}).write(
        str(path)
    )


def write_truth(folder: Path, out: Path, views: Views) -> None:
    """Skin, landmarks and cameras of the truth."""
    with np.load(folder / "skin.npz") as skin, np.load(folder / "person.npz") as person:
        vertices, faces, eyes = skin["vertices"], skin["faces"], person["eyes"]
    rows, faces = np.unique(faces[vertices[faces].mean(1)[:, 1] > SHOWN], return_inverse=True)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices[rows]]
    lines += [f"f {a} {b} {c}" for a, b, c in faces.reshape(-1, 3) + 1]
    (out / "truth/skin.obj").write_text("\n".join(lines) + "\n")
    marks = {"eye_left": eyes[0].tolist(), "eye_right": eyes[1].tolist(), "mouth": [0.0, eyes[0][1] - 0.062, 0.08]}
    (out / "truth/landmarks.json").write_text(json.dumps(marks))
    photos = [
        {
            "name": f"{i}.jpg",
            "K": view["K"],
            "width": view["size"][0],
            "height": view["size"][1],
            "distortion": [0.0] * 5,
            "world_to_camera": [*view["Rt"], [0, 0, 0, 1]],
            "head_motion": view.get("head", np.eye(4).tolist()),
        }
        for i, view in views.items()
    ]
    (out / "truth/cameras.json").write_text(json.dumps({"photos": photos}))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--kit", type=Path, required=True)
    parser.add_argument("--rig", type=Path, help="a capture with a params.json; without: photos of a phone in a room")
    parser.add_argument("--blender", required=True, help="a Python with Blender's module")
    parser.add_argument("--look", choices=sorted(LOOKS), default="bob")
    parser.add_argument("--alike", action="store_true", help="one kind of camera, not four with their own colours")
    parser.add_argument("--samples", type=int, default=8)
    args = parser.parse_args()
    folder = args.out / "truth/scene"
    for name in ("truth/labels", "truth/albedo", "truth/scene", *([] if args.rig else ["images"])):
        (args.out / name).mkdir(parents=True, exist_ok=True)
    if args.rig:
        params = json.loads((args.rig / "params.json").read_text())
        (args.out / "params.json").write_text(json.dumps(params))
        views, light = rig_views(params), studio()
    else:
        views, light = photos(np.random.default_rng(7)), np.full((4, 8, 3), 0.02)
    np.save(folder / "light.npy", light.astype(np.float32))
    write_scene(folder, args.kit, args.look, views)
    script = Path(__file__).with_name("blender.py")
    subprocess.run([args.blender, str(script), str(folder), str(args.samples)], check=True)
    if args.rig:
        develop(folder, args.out, views, args.look, args.alike)
    else:
        develop_phone(folder, args.out, views)


if __name__ == "__main__":
    main()
