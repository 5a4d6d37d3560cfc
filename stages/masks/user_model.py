"""A segmentation network of the user's: an ONNX file that OpenCV can run.

Input (1, 3, N, N) float32, RGB in [0, 1] (or normalised as ImageNet's networks expect); first output with N x N values,
the probability of 'subject', or its logit if any value lies outside [0, 1]; of two channels the second is the subject.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import UsageError
from stages.masks.region import F32, U8, Bool, Disc, resized, working_size
from stages.masks.segment_person import refined

IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_local = threading.local()  # a network holds the buffers of its last run, so each thread has its own


@dataclass(frozen=True, slots=True)
class UserModel:
    """path: the ONNX file. side: N. imagenet: whether the input is normalised with ImageNet's mean and deviation."""

    path: Path
    side: int
    imagenet: bool

    def probability(self, square: U8) -> F32:
        """(N, N) probability of 'subject' in a (N, N, 3) 8-bit RGB picture.

        Raises UsageError if the file is no network, or one of another kind.
        """
        values = square.astype(np.float32) / 255
        if self.imagenet:
            values = (values - np.array(IMAGENET_MEAN, np.float32)) / np.array(IMAGENET_DEVIATION, np.float32)
        blob = np.ascontiguousarray(values.transpose(2, 0, 1)[None])
        try:
            net = self._net()
            net.setInput(blob)
            out = np.array(net.forward(), np.float32)
        except cv2.error as e:
            raise self._fault(str(e).strip().splitlines()[-1][:200]) from e
        if out.size not in (self.side**2, 2 * self.side**2):
            raise self._fault(f"an output of shape {out.shape}")
        plane = out.reshape(-1, self.side, self.side)[-1]
        outside = plane.min() < -1e-4 or plane.max() > 1 + 1e-4
        return np.asarray(1 / (1 + np.exp(-plane.clip(-60, 60))) if outside else plane, np.float32)

    def _net(self) -> Any:
        if getattr(_local, "path", None) != self.path:
            _local.net, _local.path = cv2.dnn.readNetFromONNX(str(self.path)), self.path
        return _local.net

    def _fault(self, value: str) -> UsageError:
        return UsageError("the network can't be used", where=f"masks.model={self.path}", value=value,
                          limit=f"ONNX, input 1 x 3 x {self.side} x {self.side}, output 1 x 1 x {self.side} x "
                          f"{self.side}", remedy="set masks.model_side to the network's input, or export it again "
                          "with a fixed size")  # fmt: skip


def mask_by_model(image: U8, disc: Disc, model: UserModel, threshold: float, longest: int, seed: int) -> Bool:
    """Hard mask of the subject at the working size. The whole photo is looked at, squeezed into a square."""
    w, h = working_size(image.shape[1], image.shape[0], longest)
    small = np.asarray(resized(image, w, h), np.uint8)
    found = model.probability(np.asarray(resized(image, model.side, model.side), np.uint8))
    full = np.asarray(resized(found, w, h), np.float32)
    scale = max(w, h) / model.side
    return refined(small, full, scale, disc.scaled(w / image.shape[1]), threshold, seed)
