"""The user's networks, ONNX files that OpenCV can run: one for the subject, one for hair.

Input (1, 3, N, N) float32, RGB in [0, 1] (or normalised by ImageNet's mean and standard deviation). The first output
has N x N values: probabilities of the subject or hair, or logits if any value is outside [0, 1]; of two channels the
second is used. A network with several classes has (1, C, N, N): probabilities, or logits for a softmax.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UsageError
from pipeline.networks import network
from stages.masks.config import Config
from stages.masks.region import F32, U8, Bool, Disc, resized, working_size
from stages.masks.segment_person import refined

IMAGENET_MEAN, IMAGENET_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True, slots=True)
class UserModel:
    """path: the ONNX file. side: N. imagenet: whether the input is normalised by ImageNet's mean and standard
    deviation. of_class: index of the class, None for a network with one class. setting: name of the setting, for
    errors."""

    path: Path
    side: int
    imagenet: bool
    of_class: int | None = None
    setting: str = "masks.model"

    def probability(self, square: U8) -> F32:
        """(N, N) probability of the subject or hair in a (N, N, 3) 8-bit RGB picture.

        Raises UsageError if the file is no network, or its input or output has another shape.
        """
        values = square.astype(np.float32) / 255
        if self.imagenet:
            values = (values - np.array(IMAGENET_MEAN, np.float32)) / np.array(IMAGENET_DEVIATION, np.float32)
        blob = np.ascontiguousarray(values.transpose(2, 0, 1)[None])
        try:
            net = network(self.path, cv2.dnn.readNetFromONNX)
            net.setInput(blob)
            out = np.array(net.forward(), np.float32)
        except cv2.error as e:
            raise self._fault(str(e).strip().splitlines()[-1][:200]) from e
        count, rest = divmod(out.size, self.side**2)
        if rest or not (count in (1, 2) if self.of_class is None else self.of_class < count):
            raise self._fault(f"an output of shape {out.shape}")
        planes = out.reshape(count, self.side, self.side)
        outside = planes.min() < -1e-4 or planes.max() > 1 + 1e-4
        if self.of_class is None:
            return np.asarray(1 / (1 + np.exp(-planes[-1].clip(-60, 60))) if outside else planes[-1], np.float32)
        if outside:
            planes = np.exp(planes - planes.max(0))
        return np.asarray(planes[self.of_class] / np.maximum(planes.sum(0), 1e-9), np.float32)

    def _fault(self, value: str) -> UsageError:
        planes = "1" if self.of_class is None else f"at least {self.of_class + 1}"
        return UsageError("the network can't be used", where=f"{self.setting}={self.path}", value=value,
                          limit=f"ONNX, input 1 x 3 x {self.side} x {self.side}, output 1 x {planes} x {self.side} x "
                          f"{self.side}", remedy=f"set {self.setting}_side to the network's input, or export it again "
                          "with a fixed size")  # fmt: skip


def user_model(config: Config) -> UserModel | None:
    """The network of masks.model for the subject, if any."""
    if not config.model:
        return None
    return UserModel(Path(config.model), config.model_side, config.model_imagenet)


def hair_model(config: Config) -> UserModel | None:
    """The network of masks.hair_model for hair, if any."""
    if not config.hair_model:
        return None
    only = config.hair_model_class if config.hair_model_class >= 0 else None
    path = Path(config.hair_model)
    return UserModel(path, config.hair_model_side, config.hair_model_imagenet, only, "masks.hair_model")


def mask_by_model(image: U8, disc: Disc, model: UserModel, threshold: float, longest: int, seed: int) -> Bool:
    """Hard mask of the subject at the working size. The whole photo (H, W, 3), resized to a square, is the input."""
    w, h = working_size(image.shape[1], image.shape[0], longest)
    small = np.asarray(resized(image, w, h), np.uint8)
    found = model.probability(np.asarray(resized(image, model.side, model.side), np.uint8))
    full = np.asarray(resized(found, w, h), np.float32)
    scale = max(w, h) / model.side
    return refined(small, full, scale, disc.scaled(w / image.shape[1]), threshold, seed)
