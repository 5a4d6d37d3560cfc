"""Camera poses from rendering residuals: photos are registered to the model, cameras move where photos confirm it.

A head that moves between photos is the same six numbers: the camera moves around the head instead.

    S = mean over photos of xi_A^T G xi_B,     N = mean of |xi_A - xi_B|^2_G / 4,     xi <- S / (S + N) xi

Symbols: xi_A, xi_B the motions of a photo from each half of its pixels (registration.py), G the metric of displacement
in the picture. S estimates the mean square of the true motions, because the halves' errors are independent, and N the
error of what both halves tell: the factor is the posterior mean for a Gaussian prior of the cameras' own covariance, as
the photos themselves tell it (empirical Bayes; Efron and Morris 1973). Exact cameras have S near 0 and stay.

Gauge: the mean motion of all photos and the mean change of their distance are taken back, because turning, shifting or
scaling all cameras together is no evidence against any of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from pipeline.artifacts import RefinedCamera
from pipeline.fields.face import FaceModel
from pipeline.maths.rigid_motion import camera_of_moved, motion_between, motion_matrix
from pipeline.transforms import rows
from stages.inverse_rendering.config import Config
from stages.inverse_rendering.ray_sampling import PhotoView, factor_for
from stages.inverse_rendering.registration import Registered, register
from stages.inverse_rendering.sight import pair_of

F64 = npt.NDArray[np.float64]
REFINE_AT = (
    0.4,
    0.6,
    0.8,
)  # shares of the fit at which poses are refined: the model is sharp enough, and has time left
FEWEST_VIEWS = 3
CONFIRMED = 0.25  # share of the photos whose motion must be confirmed: without any motion it is 0.16
SMALLEST = 0.2  # pixels of the fit: root of S from which cameras are moved; a model's own errors tell motions below it


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the photos of one refinement tell. motion: root of S, and noise: root of N, in pixels of the fit's photos;
    factor: of the motions; confirmed: number of photos whose unused pixels confirm their motion."""

    motion: float
    noise: float
    factor: float
    confirmed: int


@dataclass(frozen=True, slots=True)
class Refined:
    """Views with refined cameras, the metric G of each in square pixels of the view (V, 6, 6), and the evidence."""

    views: list[PhotoView]
    metrics: F64
    evidence: Evidence


def refined(
    model: FaceModel,
    views: Sequence[PhotoView],
    first: Sequence[F64],
    side: int,
    samples: int,
    device: str,
    *,
    wanted: bool = False,
) -> Refined:
    """Refine the cameras of all views. first: (4, 4) poses before any refinement, which fix the gauge. side: of the
    fit's photos in pixels. wanted: move cameras although the photos as a whole do not ask for it."""
    found, blocks = [], []
    for n, view in enumerate(views):
        pair = pair_of(model, view, response_of(model, n), side, samples, device)
        found.append(register(pair))
        blocks.append(pair.factor)
    fit = [factor_for(v.size, side) for v in views]
    evidence = weighed(found, [b / f for b, f in zip(blocks, fit, strict=True)], wanted=wanted)
    metrics = np.stack([b * b * r.G for b, r in zip(blocks, found, strict=True)])
    if evidence.factor == 0 or not evidence.confirmed:
        return Refined(list(views), metrics, evidence)
    motions = [evidence.factor * r.xi if r.better else np.zeros(6) for r in found]
    poses = [camera_of_moved(v.world_from_cam, six) for v, six in zip(views, motions, strict=True)]
    moved = [replace(v, world_from_cam=pose) for v, pose in zip(views, in_gauge(poses, first), strict=True)]
    return Refined(moved, metrics, evidence)


def weighed(found: Sequence[Registered], scales: Sequence[float], *, wanted: bool) -> Evidence:
    """S, N and the factor of the motions. scales: pixels of the fit per block, for each photo."""
    usable = [(r, s) for r, s in zip(found, scales, strict=True) if np.isfinite(r.error)]
    confirmed = sum(r.better for r, _ in usable)
    if len(usable) < FEWEST_VIEWS:
        return Evidence(0.0, 0.0, 0.0, confirmed)
    # the middle 80 %: one photo with closed eyes or a hand must not decide for the others
    signal, noise = (_trimmed([s * s * getattr(r, k) for r, s in usable]) for k in ("signal", "noise"))
    signal = max(signal, 0.0)
    factor = signal / max(signal + noise, 1e-12)
    motion = float(np.sqrt(signal))
    enough = wanted or (motion >= SMALLEST and confirmed >= CONFIRMED * len(usable))
    return Evidence(motion, float(np.sqrt(noise)), factor if enough else 0.0, confirmed)


def _trimmed(values: Sequence[float]) -> float:
    """The mean without a tenth of the values at either end."""
    ordered = np.sort(np.asarray(values, np.float64))
    cut = len(ordered) // 10
    return float(ordered[cut : len(ordered) - cut].mean())


def in_gauge(poses: Sequence[F64], first: Sequence[F64]) -> list[F64]:
    """Poses (4, 4) after one common motion and one common factor of their distances from the origin, so that the mean
    motion against the first poses and the mean change of distance vanish."""
    out = [np.array(p) for p in poses]
    for _ in range(4):  # means of rotations are exact for small ones only, and scale and shift depend on each other
        mean = np.mean([motion_between(a, b) for a, b in zip(first, out, strict=True)], 0)
        out = [np.asarray(motion_matrix(mean) @ p, np.float64) for p in out]
        lengths = [[float(np.linalg.norm(p[:3, 3])) for p in some] for some in (first, out)]
        grown = float(np.mean([b / (a or 1.0) for a, b in zip(*lengths, strict=True)]))
        for p in out:
            p[:3, 3] /= grown or 1.0
    return out


def response_of(model: FaceModel, number: int) -> F64:
    """(3, 3) A_n of a fitted photo. [NeuFace eq. 19]"""
    if not model.spec.colour_matrices:
        return np.eye(3)
    return np.asarray(model.calibration().detach().cpu().double().numpy()[number], np.float64)


@dataclass(slots=True)
class PoseHistory:
    """The poses before any refinement (4, 4), what each refinement found, and the last metric of each view."""

    first: list[F64]
    evidence: list[Evidence]
    metrics: F64

    @classmethod
    def of(cls, views: Sequence[PhotoView]) -> PoseHistory:
        """No refinement yet."""
        return cls([np.array(v.world_from_cam) for v in views], [], np.zeros((len(views), 6, 6)))

    def refine(self, model: FaceModel, views: list[PhotoView], settings: Config, device: str) -> list[PhotoView]:
        """The views with refined cameras."""
        side, wanted = settings.image_side, settings.refine_poses == "on"
        found = refined(model, views, self.first, side, settings.samples, device, wanted=wanted)
        self.evidence.append(found.evidence)
        self.metrics = found.metrics
        return found.views

    def cameras(self, views: Sequence[PhotoView], widths: Mapping[int, int]) -> tuple[RefinedCamera, ...]:
        """The cameras of the views that moved. widths: of the whole photos in pixels, by the views' index."""
        out = []
        for view, first, G in zip(views, self.first, self.metrics, strict=True):
            if not np.array_equal(view.world_from_cam, first):
                six = motion_between(first, view.world_from_cam)
                pixels = widths[view.index] / view.size[0] * float(np.sqrt(max(float(six @ G @ six), 0.0)))
                pose = rows(view.world_from_cam)
                out.append(RefinedCamera(index=view.index, world_from_cam=pose, pixels=round(pixels, 4)))
        return tuple(out)

    def facts(self, views: Sequence[PhotoView], setting: str) -> dict[str, str | float | bool]:
        """For the report: what the first refinement found, what the last one left, and how far the cameras moved."""
        if not self.evidence:
            return {"refined": False, "why": "setting" if setting == "off" else "the fit has no refinement"}
        pairs = [(a, v.world_from_cam) for a, v in zip(self.first, views, strict=True)]
        moved = np.array([motion_between(a, b) for a, b in pairs if not np.array_equal(a, b)])
        first, last = self.evidence[0], self.evidence[-1]
        out: dict[str, str | float | bool] = {
            "refined": bool(len(moved)),
            "confirmed": first.confirmed,
            "motion_px": round(first.motion, 4),
            "noise_px": round(first.noise, 4),
            "left_px": round(last.motion, 4),
            "why": "setting" if setting == "on" else "registration of the photos",
        }
        if len(moved):
            turned, shifted = (np.median(np.linalg.norm(m, axis=1)) for m in (moved[:, :3], moved[:, 3:]))
            out |= {"median_mm": round(1e3 * float(shifted), 4), "median_degrees": round(float(np.degrees(turned)), 4)}
        return out

    def stored(self, views: Sequence[PhotoView]) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "first": torch.from_numpy(np.stack(self.first)),
            "now": torch.from_numpy(np.stack([v.world_from_cam for v in views])),
            "metrics": torch.from_numpy(self.metrics),
            "evidence": [astuple(e) for e in self.evidence],
        }

    def restore(self, views: Sequence[PhotoView], state: dict[str, Any]) -> list[PhotoView]:
        """The views with the poses of a checkpoint."""
        self.first, self.metrics = list(state["first"].numpy()), state["metrics"].numpy()
        self.evidence = [Evidence(*e) for e in state["evidence"]]
        return [replace(v, world_from_cam=np.array(p)) for v, p in zip(views, state["now"].numpy(), strict=True)]
