"""The second capture's files in the fit: its photos in the first one's asset coordinates, its predictions, its score.

Photos of the second capture are marked as `second`, and their indices follow those of the first. Where the second
capture shows the subject beyond the part that is fitted, because its frame or its extent is larger, its pixels do not
count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipeline import transforms
from pipeline.artifacts import CameraSet, FileRef, FittedPhoto, HeldOutView, Located, MaskSet, SecondFitted
from pipeline.capture_artifacts import Capture
from pipeline.colour import srgb_from_linear
from pipeline.contract import Context
from pipeline.errors import StageError, UsageError
from pipeline.fields.face import FaceModel
from pipeline.fields.geometry import GridSdf
from pipeline.images import read_alpha, read_exr, read_linear, shrink_whole
from pipeline.maths.light_frame import WORLD
from pipeline.maths.tracing import box_interval
from pipeline.together_artifacts import Together
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.held_out_colour import held_out_colours
from stages.inverse_rendering.initial_geometry import Start
from stages.inverse_rendering.load_views import read_labels, read_views
from stages.inverse_rendering.moving_light import light_frame
from stages.inverse_rendering.outputs import predict_held_out, write_light
from stages.inverse_rendering.ray_sampling import F32, U8, PhotoView, factor_for, image_rays
from stages.inverse_rendering.residuals import decibels
from stages.inverse_rendering.second_capture import Second
from stages.inverse_rendering.systems import COMPARED

FOLDER = "second"  # of its files in the artifact
REGION_SIDE = 320  # pixels: longer side at which it is decided what is fitted
MIN_VIEWS = 3
SHOWN = 0.02  # alpha from which a pixel shows the subject


@dataclass(frozen=True, slots=True)
class Other:
    """The second capture. poses: in the first one's asset coordinates. offset: added to its indices in the fit."""

    capture: Located[Capture]
    poses: CameraSet
    masks: Located[MaskSet]
    offset: int
    placed: Together

    @property
    def fitted(self) -> list[int]:
        """The indices of its fitted photos in the fit."""
        return [i + self.offset for i in self.usable]

    @property
    def widths(self) -> dict[int, int]:
        """Widths of its whole photos in pixels, by their indices in the fit."""
        return {c.index + self.offset: c.width for c in self.poses.cameras}

    def facts(self, found: SecondFitted) -> dict[str, str | float | bool]:
        """For the report."""
        out: dict[str, str | float | bool] = {
            "placed_by": self.placed.source,
            "agreement": self.placed.agreement,
            "fitted_photos": len(self.usable),
            "held_out_photos": len(found.held_out),
        }
        if found.photos:
            out["psnr_fitted"] = round(float(np.mean([p.psnr for p in found.photos])), 4)
        if found.psnr_held_out is not None:
            out["psnr_held_out"] = found.psnr_held_out
        return out

    @property
    def usable(self) -> list[int]:
        """Its fitted photos."""
        held = {v.index for v in self.capture.artifact.views if v.holdout}
        dropped = set(self.masks.artifact.dropped)
        return [c.index for c in self.poses.cameras if c.index not in held and c.index not in dropped]


def moved_poses(poses: CameraSet, first_from_second: transforms.F64) -> CameraSet:
    """Cameras of the second capture in the asset coordinates of the first."""
    moved = tuple(
        c.model_copy(
            update={
                "world_from_cam": transforms.rows(
                    transforms.rescale_camera(first_from_second, transforms.matrix(c.world_from_cam))
                )
            }
        )
        for c in poses.cameras
    )
    back = transforms.matrix(poses.capture_from_asset) @ np.linalg.inv(first_from_second)
    return poses.model_copy(update={"cameras": moved, "capture_from_asset": transforms.rows(back)})


def check_supported(captures: Sequence[Capture], config: Config) -> None:
    """Raises UsageError or StageError for what two captures can't be combined with."""
    fault = ""
    if config.preset in COMPARED:
        fault = f"the preset {config.preset}"
    elif any(c.stage is not None for c in captures):
        fault = "a light stage"
    elif any(c.polarised for c in captures):
        fault = "polarised pairs"
    if fault:
        raise UsageError(
            "a second capture can't be combined with this",
            where="--also",
            value=fault,
            limit="plain photos of both captures, and our own fit",
            remedy="leave --also out, or use plain photos and another preset",
        )


def read_second(
    other: Other, names: Sequence[str], start: Start, settings: Config, calibrated: bool, device: str
) -> Second:
    """The fitted photos of the second capture. names: the first one's label names.

    Raises:
        StageError: too few photos, or a light that moves with the camera.
    """
    usable = other.usable
    if len(usable) < MIN_VIEWS:
        raise StageError(
            "too few views of the second capture are left to fit",
            where="--also",
            value=len(usable),
            limit=f"at least {MIN_VIEWS}",
            remedy="add photos, hold out fewer with --holdout, or leave --also out",
        )
    views = read_views(other.capture, other.poses, other.masks, usable, settings.image_side)
    fired = [v.flash is True for v in other.capture.artifact.views if v.index in set(usable)]
    refuse_moving(light_frame(views, start, settings.light_frame, device, sum(fired) / len(fired)).frame, "second")
    surface = start.surface(device)
    marked = [replace(limited(v, surface, device), index=v.index + other.offset, second=True) for v in views]
    labels = [_renamed(codes, other.masks.artifact.label_names, names) for codes in read_labels(other.masks, usable)]
    return Second(marked, labels, calibrated)


def refuse_moving(frame: str, which: str) -> None:
    """Raises StageError where the light of a capture moves with the camera."""
    if frame != WORLD:
        raise StageError(
            f"the light of the {which} capture moves with the camera",
            where="--also",
            value=frame,
            limit="two captures whose lights stand still",
            remedy="leave --also out: a light that moves tells albedo and light apart by itself; if it stands still, "
            "set inverse_rendering.light_frame=world",
        )


def limited(view: PhotoView, surface: GridSdf, device: str) -> PhotoView:
    """The view, without the pixels that show the subject where nothing is fitted. surface: the initial one."""
    factor = factor_for(view.size, REGION_SIDE)
    rays = image_rays(view, factor, device)
    near, far = box_interval(rays.o, rays.d, *surface.box())
    _, hit, _ = surface.trace(rays.o, rays.d, near, far)
    w, h = view.size
    there = (hit & (far > near)).cpu().numpy().reshape(h // factor, w // factor).astype(np.uint8)
    there = np.asarray(cv2.dilate(there, np.ones((3, 3), np.uint8)), np.uint8)
    whole = cv2.copyMakeBorder(
        np.kron(there, np.ones((factor, factor), np.uint8)), 0, h % factor, 0, w % factor, cv2.BORDER_REPLICATE
    )
    beyond = (view.alpha > SHOWN) & (whole == 0)
    if not beyond.any():
        return view
    asked = np.ones_like(view.alpha) if view.asked is None else view.asked
    return replace(view, asked=np.where(beyond, np.float32(0), asked))


def _renamed(codes: U8 | None, own: Sequence[str], names: Sequence[str]) -> U8 | None:
    """Label codes of the second capture by the names of the first; 0 for names that it does not have."""
    if codes is None or tuple(own) == tuple(names):
        return codes
    table = np.zeros(256, np.uint8)
    for code, name in enumerate(own):
        table[code] = list(names).index(name) if name in names else 0
    return np.asarray(table[codes], np.uint8)


# ------------------------------------------------------------------ after the fit
def second_result(
    model: FaceModel, other: Other, config: Config, photos: Sequence[FittedPhoto], context: Context
) -> SecondFitted:
    """Write the light and the held-out views of the second capture, and score them. model: that of its light."""
    inside = replace(context, workdir=context.workdir / FOLDER)
    inside.workdir.mkdir(parents=True, exist_ok=True)
    write_light(model, inside)
    colours = held_out_colours(model, other.capture.artifact, other.poses, other.usable)
    held = predict_held_out(model, other.poses, colours.responses, config.image_side, config.samples, inside)
    scores = [s for v in held if (s := score(v, other, inside)) is not None]
    return SecondFitted(
        light=_within(inside.file("light.json")),
        held_out=tuple(v.model_copy(update={"exr": _within(v.exr), "png": _within(v.png)}) for v in held),
        photos=tuple(p.model_copy(update={"index": p.index - other.offset}) for p in photos),
        psnr_held_out=round(float(np.mean(scores)), 4) if scores else None,
    )


def _within(file: FileRef) -> FileRef:
    return file.model_copy(update={"path": f"{FOLDER}/{file.path}"})


def score(held: HeldOutView, other: Other, context: Context) -> float | None:
    """PSNR of a held-out view in dB over the subject's pixels that count, sRGB; None for a photo without a mask."""
    mask = next((m for m in other.masks.artifact.masks if m.index == held.index), None)
    if mask is None:
        return None
    photo = next(v for v in other.capture.artifact.views if v.index == held.index)
    shown, _ = read_exr(context.workdir / held.exr.path)
    alpha = read_alpha(other.masks.path(mask.mask))
    if mask.asked is not None:
        alpha = alpha * (read_alpha(other.masks.path(mask.asked)) > 0.5)
    truth, alpha = (shrink_whole(a, held.scale) for a in (read_linear(other.capture.path(photo.image)), alpha))
    inside = alpha > 0.5
    if not inside.any():
        return None
    a, b = (_encoded(np.asarray(x, np.float32)[inside][:, :3]) for x in (shown, truth))
    return decibels(float(((a - b) ** 2).mean()))


def _encoded(linear: F32) -> F32:
    return np.asarray(srgb_from_linear(linear.clip(0, 1)), np.float32)
