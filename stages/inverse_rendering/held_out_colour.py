"""The colour response of a held-out photo, from those of the fitted photos around it.

Exposure, white balance and shadows of a rig differ between photos, and no pixel of a held-out photo may tell them. The
fitted photos' responses A_n do, where they change smoothly with the direction from which a photo was taken (automatic
exposure, a rig between lamp and subject) or with time (clouds). They are then interpolated by a Gaussian process; else
the mean is the best that is known.

Symbols: A_n (3, 3) fitted response of photo n; x_n its place, the direction of its camera from the subject's centre or
its rank in time; k(x, y) = exp(-|x - y|^2 / 2 l^2), l the length, q the variance of the noise as a share of that of the
responses. Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, eq. 2.25 and, for the errors of
leaving out one photo, eq. 5.12.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.artifacts import CameraSet, Matrix
from pipeline.capture_artifacts import Capture
from pipeline.fields.face import FaceModel
from pipeline.transforms import rows

F64 = npt.NDArray[np.float64]

LEAST = 16  # photos; chance finds an order in one of seven sets of ten responses without any, in one of 100 of these
GAIN = 0.5  # the squared error of leaving out one photo must fall below this share of the mean's
LENGTHS = {
    "direction": (0.1, 0.2, 0.4, 0.8),  # chords of the unit sphere
    "time": (0.02, 0.05, 0.1, 0.2),  # shares of the whole sequence
}
NOISES = (0.03, 0.1, 0.3, 1.0)


@dataclass(frozen=True, slots=True)
class Interpolation:
    """How responses are interpolated. by: `direction`, `time`, or `mean` where neither is better than the mean; length
    and noise: l and q; error, of_mean: root mean squared errors of leaving out one photo, per entry of A_n."""

    by: str
    length: float
    noise: float
    error: float
    of_mean: float

    def facts(self) -> dict[str, str | float | bool]:
        """For the report."""
        return {
            "by": self.by,
            "error": round(self.error, 5),
            "error_of_mean": round(self.of_mean, 5),
            "why": "errors of leaving out one photo",
        }


@dataclass(frozen=True, slots=True)
class HeldOutColours:
    """responses: rows (3, 3) for each held-out photo, by its index. facts: how they were found, for the report."""

    responses: dict[int, Matrix]
    facts: dict[str, str | float | bool]


def held_out_colours(model: FaceModel, capture: Capture, poses: CameraSet, fitted: Sequence[int]) -> HeldOutColours:
    """e_n A_h of every held-out view: its exposure times the response that the fitted photos (indices in the model's
    order) of the same camera tell; the identity where there are none. [NeuFace eq. 19]

    Differs: the paper has one camera, and scores each test view after a 3 x 3 matrix fitted to that view.
    """
    responses: dict[int, Matrix] = {}
    facts: dict[str, str | float | bool] = {}
    matrices = model.calibration().detach().cpu().double().numpy() if model.spec.calibrated else None
    centre = {c.index: np.array(c.world_from_cam, np.float64)[:3, 3] for c in poses.cameras}
    for group in sorted({v.camera_group for v in capture.views if v.holdout}):
        views = [v for v in capture.views if v.camera_group == group and v.index in centre]
        asked = [v for v in views if v.holdout]
        taken = {v.index for v in views}
        alike = [n for n, i in enumerate(fitted) if i in taken]
        found = np.broadcast_to(np.eye(3), (len(asked), 3, 3))
        if matrices is not None and alike and asked:
            order = [v.index for v in views]
            known, wanted = (places(order, centre, of) for of in ([fitted[n] for n in alike], [v.index for v in asked]))
            how = choose(matrices[alike], known)
            found = interpolate(how, matrices[alike], known, wanted)
            if len(alike) > int(facts.get("photos", 0)):
                facts = {**how.facts(), "photos": len(alike)}
        responses |= {v.index: rows(v.exposure * matrix) for v, matrix in zip(asked, found, strict=True)}
    return HeldOutColours(responses, facts)


def places(order: Sequence[int], centre: Mapping[int, F64], of: Sequence[int]) -> dict[str, F64]:
    """Places of photos `of` (N): `direction` (N, 3), unit vectors from the origin of asset coordinates to the cameras'
    centres, and `time` (N, 1), their rank in the sorted `order` from 0 to 1. A camera at the origin has the direction
    0."""
    toward = np.array([centre[i] for i in of], np.float64).reshape(-1, 3)
    rank = {index: n / max(len(order) - 1, 1) for n, index in enumerate(sorted(order))}
    return {
        "direction": toward / np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12),
        "time": np.array([rank[i] for i in of], np.float64).reshape(-1, 1),
    }


def choose(matrices: F64, known: Mapping[str, F64]) -> Interpolation:
    """The interpolation of responses (N, 3, 3) at places `known` that predicts left-out photos best. The mean stays
    where fewer than `LEAST` photos are given, where all responses are equal, and where nothing has less than `GAIN` of
    its squared error."""
    entries = matrices.reshape(len(matrices), 9)
    of_mean = _left_out_mean(entries)
    best = Interpolation("mean", 0.0, 0.0, of_mean, of_mean)
    if len(matrices) < LEAST or not of_mean > 1e-9:
        return best
    for by, x in known.items():
        for length, noise in itertools.product(LENGTHS[by], NOISES):
            error = _left_out(entries, x, length, noise)
            if error**2 < GAIN * of_mean**2 and error < best.error:
                best = Interpolation(by, length, noise, error, of_mean)
    return best


def interpolate(how: Interpolation, matrices: F64, known: Mapping[str, F64], wanted: Mapping[str, F64]) -> F64:
    """(M, 3, 3) responses at places `wanted` from those (N, 3, 3) at places `known`."""
    mean = matrices.mean(0)
    if how.by == "mean":
        count = len(next(iter(wanted.values())))
        return np.broadcast_to(mean, (count, 3, 3)).copy()
    x, y = known[how.by], wanted[how.by]
    weights = np.linalg.solve(_covariance(x, how.length, how.noise), (matrices - mean).reshape(len(x), 9))
    return np.asarray(mean + (_kernel(y, x, how.length) @ weights).reshape(-1, 3, 3), np.float64)


def _left_out_mean(entries: F64) -> float:
    """Root mean squared error of each row by the mean of the others."""
    count = len(entries)
    if count < 2:
        return 0.0
    error = (entries - entries.mean(0)) * (count / (count - 1))
    return float(np.sqrt((error**2).mean()))


def _left_out(entries: F64, x: F64, length: float, noise: float) -> float:
    """The same by the interpolation from the others. The mean is that of all photos: one has a small share of it."""
    inverse = np.linalg.inv(_covariance(x, length, noise))
    error = (inverse @ (entries - entries.mean(0))) / np.diag(inverse)[:, None]
    return float(np.sqrt((error**2).mean()))


def _covariance(x: F64, length: float, noise: float) -> F64:
    return _kernel(x, x, length) + noise * np.eye(len(x))


def _kernel(a: F64, b: F64, length: float) -> F64:
    apart = ((a[:, None] - b[None]) ** 2).sum(-1)
    return np.asarray(np.exp(-apart / (2 * length**2)), np.float64)
