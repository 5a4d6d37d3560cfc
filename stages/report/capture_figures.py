"""The input of the reconstruction: a drawing of the cameras, photos without a camera, outlines of the masks.

The drawing is a parallel projection of asset coordinates (metres): a point p is drawn at (p . right, -p . up).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt
from markupsafe import Markup, escape

from pipeline.artifacts import Camera, CameraSet, FittedPhoto, Located
from pipeline.images import read_alpha, read_encoded
from pipeline.transforms import F64, matrix
from stages.report.collect import Started
from stages.report.metrics import encoded
from stages.report.page import Picture
from stages.report.pictures import data_uri, to_bytes
from stages.report.sphere import hidden_parts, legend, sphere

SIDE, MARGIN = 420, 26  # drawing units of a panel
SHOWN_POINTS = 1500
FRUSTUM = 0.12  # of the cameras' median distance: length of a drawn camera
VIEWPOINTS = (("from the front right, above", 35.0, 20.0), ("from above", 0.0, 89.9))
OUTLINE = (255, 64, 0)
KINDS = {"fitted": "#2a9d6f", "held out": "#3f7fd1", "mask dropped": "#d9822b"}


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A row of the table of cameras. error_px: mean reprojection error; hull_iou: IoU of mask and others' hull; fit:
    how the fit shows the photo, and how much the photo counted in it; None if it was not fitted."""

    name: str
    kind: str
    error_px: float | None
    hull_iou: float | None
    mask: str
    fit: FittedPhoto | None = None


@dataclass(frozen=True, slots=True)
class Captured:
    """Data of this section of the page. sphere: directions that the photos cover; hidden: parts that they hardly cover;
    lost: photos without a camera or left out, with the reason."""

    drawing: Markup
    sphere: Markup
    seen: Sequence[tuple[str, str]]
    hidden: Sequence[str]
    legend: Sequence[tuple[str, str]]
    rows: Sequence[CameraRow]
    lost: Sequence[str]
    outlines: Sequence[Picture]
    more: int


def captured(r: Started, side: int, shown: int, fitted: Sequence[FittedPhoto] = ()) -> Captured:
    """The drawing, the table and the outlines of the `shown` worst masks. fitted: the photos in the finished fit."""
    kinds = camera_kinds(r)
    rows = sorted(_rows(r, kinds, fitted), key=lambda row: -(row.error_px or 0.0))
    why = r.poses.artifact.left_out
    lost = [
        f"{n}: no camera pose was found" + (f"; {why[n]}" if n in why else "") for n in r.poses.artifact.unregistered
    ]
    lost += r.capture.artifact.left_out
    outlines = _outlines(r, side, shown)
    seen = r.poses.artifact.seen_directions
    return Captured(drawing(r.poses, kinds), sphere(seen), legend(), hidden_parts(seen), list(KINDS.items()), rows,
                    lost, outlines, len(r.masks.artifact.masks) - len(outlines))  # fmt: skip


def camera_kinds(r: Started) -> dict[int, str]:
    """What each camera's photo was used for, by its index."""
    held = {v.index for v in r.capture.artifact.views if v.holdout}
    dropped = set(r.masks.artifact.dropped)
    return {c.index: "mask dropped" if c.index in dropped else "held out" if c.index in held else "fitted"
            for c in r.poses.artifact.cameras}  # fmt: skip


def _rows(r: Started, kinds: dict[int, str], fitted: Sequence[FittedPhoto]) -> list[CameraRow]:
    masks = {m.index: m for m in r.masks.artifact.masks}
    errors = r.poses.artifact.view_errors_px
    fits = {p.index: p for p in fitted}
    out = []
    for c in r.poses.artifact.cameras:
        m = masks.get(c.index)
        out.append(CameraRow(c.name, kinds[c.index], errors.get(c.name), m.hull_iou if m else None,
                             m.source if m else "none", fits.get(c.index)))  # fmt: skip
    return out


def drawing(poses: Located[CameraSet], kinds: dict[int, str]) -> Markup:
    """An inline SVG: sparse points, the region of interest and the cameras as small pyramids, from two directions."""
    found = poses.artifact
    points = _points(poses)
    centres = np.array([matrix(c.world_from_cam)[:3, 3] for c in found.cameras])
    length = FRUSTUM * float(np.median(np.linalg.norm(centres, axis=1)))
    reach = 1.05 * max(float(np.linalg.norm(centres, axis=1).max()), found.roi_radius) + length
    scale = (SIDE / 2 - MARGIN) / reach
    panels = [_panel(p, scale, points, found, kinds, length, i * SIDE) for i, p in enumerate(VIEWPOINTS)]
    return Markup(f'<svg viewBox="0 0 {2 * SIDE} {SIDE}" role="img" aria-label="cameras around the subject">'
                  f'{"".join(panels)}</svg>')  # fmt: skip


def _panel(
    viewpoint: tuple[str, float, float], scale: float, points: F64, found: CameraSet, kinds: dict[int, str],
    length: float, left: float,
) -> str:  # fmt: skip
    name, azimuth, elevation = viewpoint
    right, up = _axes(azimuth, elevation)

    def place(p: F64) -> F64:
        return np.stack([left + SIDE / 2 + scale * (p @ right), SIDE / 2 - scale * (p @ up)], -1)

    dots = "".join(f"M{x:.1f} {y:.1f}h.01" for x, y in place(points)) if len(points) else ""
    middle = place(np.zeros((1, 3)))[0]
    out = [f'<path d="{dots}" stroke="currentColor" stroke-opacity=".45" stroke-width="1.3" stroke-linecap="round"/>',
           f'<circle cx="{middle[0]:.1f}" cy="{middle[1]:.1f}" r="{scale * found.roi_radius:.1f}" fill="none" '
           'stroke="currentColor" stroke-dasharray="3 4" stroke-opacity=".5"/>']  # fmt: skip
    for c in found.cameras:
        lines = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in _pyramid(c, length, place))
        out.append(f'<path d="{lines}" fill="none" stroke="{KINDS[kinds[c.index]]}" stroke-width="1.2">'
                   f"<title>{escape(c.name)}: {kinds[c.index]}</title></path>")  # fmt: skip
    out.append(f'<text x="{left + 8}" y="{SIDE - 8}" font-size="12" fill="currentColor">{name}</text>')
    return "".join(out)


def _axes(azimuth: float, elevation: float) -> tuple[F64, F64]:
    """Right and up vectors (3,) of a viewpoint. azimuth: degrees around +Y from +Z; elevation: degrees."""
    a, e = np.radians([azimuth, elevation])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    toward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    return right, np.cross(toward, right)


class _Place(Protocol):
    def __call__(self, p: F64, /) -> F64: ...


def _pyramid(camera: Camera, length: float, place: _Place) -> list[tuple[F64, F64]]:
    """Edges of a camera's pyramid: from the centre to the corners of the frame, around the frame, a mark on its top."""
    K, pose = matrix(camera.K), matrix(camera.world_from_cam)
    w, h = camera.width, camera.height
    uv = np.array([[0, 0], [w, 0], [w, h], [0, h], [w / 2, -0.2 * h]], np.float64)
    flat = np.linalg.solve(K[:2, :2], (uv - K[:2, 2]).T).T
    flat *= 0.5 / max(
        float(np.abs(flat[:4]).max()), 1e-9
    )  # all focal lengths are drawn alike: only the direction matters
    corners = np.concatenate([flat, np.ones((5, 1))], 1) * length @ pose[:3, :3].T + pose[:3, 3]
    at, centre = place(corners), place(pose[None, :3, 3])[0]
    edges = [(centre, at[i]) for i in range(4)] + [(at[i], at[(i + 1) % 4]) for i in range(4)]
    return [*edges, (at[0], at[4]), (at[4], at[1])]


def _points(poses: Located[CameraSet]) -> F64:
    """(M, 3) sparse points near the subject, at most SHOWN_POINTS; none for given cameras."""
    if poses.artifact.points is None:
        return np.zeros((0, 3))
    with np.load(poses.path(poses.artifact.points), allow_pickle=False) as data:
        points = np.asarray(data["points"], np.float64)
    near = points[np.linalg.norm(points, axis=1) < 4 * poses.artifact.roi_radius]
    return np.asarray(near[:: max(1, -(-len(near) // SHOWN_POINTS))], np.float64)


def _outlines(r: Started, side: int, shown: int) -> list[Picture]:
    """Photos with the outline of their mask; the one that agrees least with the others comes first."""
    views = {v.index: v for v in r.capture.artifact.views}
    masks = sorted(r.masks.artifact.masks, key=lambda m: (m.hull_iou if m.hull_iou is not None else 2.0, m.index))
    out = []
    for m in masks[:shown]:
        view = views[m.index]
        photo = outlined(read_encoded(r.capture.path(view.image)), read_alpha(r.masks.path(m.mask)), side)
        agreement = "" if m.hull_iou is None else f", {m.hull_iou:.3f}"
        dropped = ", not fitted" if m.index in r.masks.artifact.dropped else ""
        out.append(Picture(data_uri(photo, side), f"{view.name}: {m.source}{agreement}{dropped}"))
    return out


def photos_named(r: Started, names: Sequence[str], side: int) -> list[Picture]:
    """The photos of these names with the outlines of their masks. Names without a photo are left out."""
    views = {v.name: v for v in r.capture.artifact.views}
    masks = {m.index: m for m in r.masks.artifact.masks}
    out = []
    for view in (views[name] for name in names if name in views):
        image, mask = read_encoded(r.capture.path(view.image)), masks.get(view.index)
        alpha = np.zeros(image.shape[:2], np.float32) if mask is None else read_alpha(r.masks.path(mask.mask))
        out.append(Picture(data_uri(outlined(image, alpha, side), side), view.name))
    return out


def outlined(
    image: npt.NDArray[np.generic], alpha: npt.NDArray[np.float32], side: int
) -> npt.NDArray[np.uint8]:  # fmt: skip
    """(h, w, 3) 8-bit sRGB picture of a decoded photo, no larger than `side`, with the contour alpha = 0.5 drawn."""
    out = reduced(image, side)
    inside = (np.asarray(cv2.resize(alpha, out.shape[1::-1], interpolation=cv2.INTER_AREA)) >= 0.5).astype(np.uint8)
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(out, contours, -1, OUTLINE, 1)
    return out


def reduced(image: npt.NDArray[np.generic], side: int) -> npt.NDArray[np.uint8]:
    """(h, w, 3) 8-bit sRGB picture of a decoded photo (H, W, C), no larger than `side`."""
    shrink = min(1.0, side / max(image.shape[:2]))
    size = (max(1, round(image.shape[1] * shrink)), max(1, round(image.shape[0] * shrink)))
    plane = np.asarray(image[..., :3], np.float32)
    if np.issubdtype(image.dtype, np.integer):
        plane = plane / np.float32(np.iinfo(image.dtype.name).max)
    else:
        plane = np.asarray(encoded(plane / max(float(np.quantile(plane, 0.99)), 1e-6)), np.float32)
    small = np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.float32)
    return to_bytes(small)
