"""The pictures of docs/photographing.md: the demo's head, photographed well and badly.

    python -m benchmarks.photographing_pictures --out docs/pictures/photographing

Everything is rendered by the demo's own renderer, in the sRGB encoding of its photos. Some two minutes on a core.

    circles.jpg   three circles of cameras around the head, drawn, and what three of them see
    overlap.jpg   neighbouring photos 15 degrees apart, and 60 degrees apart
    light.jpg     one light in two photos, a light that moved between them, a hard light with shadows
    faults.jpg    a good photo, clipped highlights, motion blur, a head too small in the picture
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from benchmarks.overview_picture import GAP, strip
from pipeline.demo import head, light
from pipeline.demo.capture import EXPOSURE, srgb_from_linear
from pipeline.demo.mesh import Mesh, mesh_from_distance
from pipeline.demo.render import Camera, Scene, render, scene_from_mesh
from pipeline.demo.rig import FIELD, TARGET

U8 = npt.NDArray[np.uint8]
F64 = npt.NDArray[np.float64]
SIDE = 240  # pixels of a picture, as of benchmarks.overview_picture
STEP = 0.0015  # metres of the mesh
SAMPLES, OF_LAMPS = 8, 64  # of each lobe in a quarter pixel: a small lamp needs more
RINGS = ((0.0, (60, 110, 30)), (30.0, (170, 90, 20)), (-30.0, (30, 90, 210)))  # elevation, colour (BGR)
EVERY = 15  # degrees between two photos
BACKGROUND = 0.16  # linear radiance behind the head
CLIPPED, BLUR = 3.2, 15  # exposure of the clipped photo; pixels that the camera moved
QUALITY = 85


def main() -> int:
    """Write the pictures; see above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    mesh = mesh_from_distance(head.signed_distance, head.distance_and_gradient, head.BOUNDS, STEP)
    soft = scene_from_mesh(mesh, light.studio_coefficients(EXPOSURE), SAMPLES, 0)
    made = {"circles": circles(soft), "overlap": overlap(soft), "light": lights(mesh, soft), "faults": faults(soft)}
    for name, picture in made.items():
        cv2.imwrite(str(given.out / f"{name}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return 0


def camera(azimuth: float, elevation: float = 0.0, field: float = FIELD) -> Camera:
    """A camera 1 m from the head, looking at it. azimuth, elevation: degrees; field: metres that the picture shows."""
    a, e = np.radians(azimuth), np.radians(elevation)
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.cross((0.0, 1.0, 0.0), back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, -np.cross(back, right), -back])
    middle, focal = (SIDE - 1) / 2, SIDE / field
    k = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1.0]])
    return Camera(k, np.concatenate([rotation, -(rotation @ (TARGET + back))[:, None]], 1), SIDE)


def seen(scene: Scene, view: Camera) -> F64:
    """(SIDE, SIDE, 3) linear, over an even background."""
    picture = render(scene, view, 0)
    return np.asarray(picture.radiance + BACKGROUND * (1 - picture.alpha[..., None]), np.float64)


def photo(linear: F64) -> U8:
    """8-bit sRGB, BGR."""
    return np.ascontiguousarray(srgb_from_linear(linear)[..., ::-1])


def marked(image: U8, *, good: bool) -> U8:
    """With a green or red edge and a tick or a cross, which tell without colour too."""
    out, colour = image.copy(), (60, 140, 20) if good else (40, 40, 200)
    cv2.rectangle(out, (0, 0), (SIDE - 1, SIDE - 1), colour, 4)
    lines = [[(10, 22), (17, 30), (32, 10)]] if good else [[(10, 10), (30, 30)], [(30, 10), (10, 30)]]
    for line in lines:
        cv2.polylines(out, [np.array(line)], False, colour, 4, cv2.LINE_AA)
    return out


def rows(*strips: U8) -> U8:
    """Strips below each other, filled with white to the widest."""
    width = max(s.shape[1] for s in strips)
    filled = [
        cv2.copyMakeBorder(s, 0, GAP, 0, width - s.shape[1], cv2.BORDER_CONSTANT, value=(255,) * 3) for s in strips
    ]
    return np.asarray(np.concatenate(filled), np.uint8)


# ------------------------------------------------------------------ the pictures
def circles(scene: Scene) -> U8:
    """The cameras from above and from the side, and what one of each circle sees."""
    names = ("at eye height", "30 degrees above", "30 degrees below")
    views = [(photo(seen(scene, camera(20, e))), n) for (e, _), n in zip(RINGS, names, strict=True)]
    return strip([(drawn(up=2), "from above"), (drawn(up=1), "from the side"), *views])


def drawn(up: int) -> U8:
    """The cameras of three circles, seen along an axis. up: 2 from above (the face looks down), 1 from the side (it
    looks to the right)."""
    picture = np.full((SIDE, SIDE, 3), 255, np.uint8)
    middle, reach = SIDE // 2, 0.42 * SIDE
    for elevation, colour in RINGS:
        between = EVERY / 2 if elevation < 0 else 0.0  # the lower circle stands between the upper one, seen from above
        for azimuth in np.radians(np.arange(0, 360, EVERY) + between):
            e = np.radians(elevation)
            x, y, z = np.sin(azimuth) * np.cos(e), np.sin(e), np.cos(azimuth) * np.cos(e)
            across, down = (x, z) if up == 2 else (z, -y)
            at = (round(middle + reach * across), round(middle + reach * down))
            cv2.circle(picture, at, 4, colour, -1, cv2.LINE_AA)
    axes, nose = ((22, 28), (middle, middle + 34)) if up == 2 else ((28, 36), (middle + 36, middle + 4))
    cv2.ellipse(picture, (middle, middle), axes, 0, 0, 360, (150, 150, 150), -1, cv2.LINE_AA)
    cv2.circle(picture, nose, 6, (150, 150, 150), -1, cv2.LINE_AA)
    return picture


def overlap(scene: Scene) -> U8:
    """Steps of 15 degrees above, of 60 degrees below."""
    strips = []
    for step, good, said in ((15, True, "15 degrees apart"), (60, False, "60 degrees apart")):
        names = ["first photo", f"next, {said}", "and the next"]
        pictures = [photo(seen(scene, camera(step * i - 20))) for i in range(3)]
        strips.append(strip([(marked(p, good=good), n) for p, n in zip(pictures, names, strict=True)]))
    return rows(*strips)


def lights(mesh: Mesh, soft: Scene) -> U8:
    """Two photos under one light; two between which the light moved; one under a hard light."""
    views = camera(-15), camera(15)
    still = [marked(photo(seen(soft, v)), good=True) for v in views]
    sides = [lamp(mesh, (x, 0.35, 0.5)) for x in (0.8, -0.8)]
    moved = [marked(photo(seen(s, v)), good=False) for s, v in zip(sides, views, strict=True)]
    hard = marked(photo(seen(lamp(mesh, (0.55, 0.75, 0.35), shadows=True), views[0])), good=False)
    upper = strip([(still[0], "soft, still light"), (still[1], "the same in the next photo")])
    lower = strip([(moved[0], "lamp at one side"), (moved[1], "moved in the next"), (hard, "hard light from above")])
    return rows(upper, lower)


def lamp(mesh: Mesh, towards: tuple[float, float, float], *, shadows: bool = False) -> Scene:
    """The head under one strong lamp, almost without light from elsewhere."""
    box = light.SoftBox(towards, 0.35, 0.35, (48.0, 46.0, 43.0))
    coefficients = np.zeros((light.COEFFICIENTS, 3))
    directions, solid_angle = light._box_points(box)
    degree = np.repeat(np.arange(light.DEGREE + 1), 2 * np.arange(light.DEGREE + 1) + 1)
    coefficients += (light.real_basis(directions).T @ solid_angle)[:, None] * np.asarray(box.radiance)
    coefficients *= light.kernel_bands()[degree][:, None]
    coefficients[0] += np.sqrt(4 * np.pi) * 0.06
    return replace(scene_from_mesh(mesh, coefficients * EXPOSURE, OF_LAMPS, 0, shadows))


def faults(scene: Scene) -> U8:
    """A good photo and three bad ones of the same view."""
    linear, small = seen(scene, camera(20)), seen(scene, camera(20, field=3 * FIELD))
    kernel = np.zeros((BLUR, BLUR))
    kernel[BLUR // 2] = 1 / BLUR
    blurred = np.asarray(cv2.filter2D(linear, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.float64)
    shown = (
        (linear, "sharp, not clipped", True), (CLIPPED * linear, "clipped highlights", False),
        (blurred, "motion blur", False), (small, "head too small", False),
    )  # fmt: skip
    return strip([(marked(photo(p), good=good), n) for p, n, good in shown])


if __name__ == "__main__":
    raise SystemExit(main())
