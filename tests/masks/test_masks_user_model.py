"""A network of the user's: a smallest ONNX file, written byte by byte, and files that are none."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import UsageError
from stages.masks.region import Disc
from stages.masks.sources import to_full_size
from stages.masks.stage import Config
from stages.masks.user_model import UserModel, hair_model, mask_by_model, user_model


def _field(number: int, value: bytes | int | str) -> bytes:
    """A protobuf field: varint, or length and bytes."""

    def varint(n: int) -> bytes:
        out = b""
        while True:
            n, low = n >> 7, n & 0x7F
            out += bytes([low | (0x80 if n else 0)])
            if not n:
                return out

    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def write_red_detector(path: Path, side: int, gain: float = 20.0) -> Path:
    """output = gain * (red - green), a 1 x 1 convolution: a logit."""
    return write_network(path, side, [(gain, -gain, 0.0)])


def write_network(path: Path, side: int, rows: list[tuple[float, float, float]]) -> Path:
    """A 1 x 1 convolution from colours to an output channel for each row."""
    weights = b"".join(struct.pack("<3f", *r) for r in rows)
    tensor = b"".join(_field(1, d) for d in (len(rows), 3, 1, 1)) + _field(2, 1) + _field(8, "w") + _field(9, weights)
    node = _field(1, "x") + _field(1, "w") + _field(2, "y") + _field(4, "Conv")

    def value(name: str, channels: int) -> bytes:
        shape = b"".join(_field(1, _field(1, d)) for d in (1, channels, side, side))
        return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, shape)))

    graph = (
        _field(1, node)
        + _field(2, "g")
        + _field(5, tensor)
        + _field(11, value("x", 3))
        + _field(12, value("y", len(rows)))
    )
    path.write_bytes(_field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13)))
    return path


def test_a_network_of_the_users_finds_its_subject(tmp_path: Path) -> None:
    model = UserModel(write_red_detector(tmp_path / "net.onnx", 64), 64, False)
    y, x = np.mgrid[0:150, 0:200]
    truth = np.hypot(x - 100, y - 70) < 40
    image = np.where(truth[..., None], [200, 60, 60], [90, 110, 100]).astype(np.uint8)
    square = np.full((64, 64, 3), (200, 60, 60), np.uint8)
    np.testing.assert_allclose(model.probability(square), 1 / (1 + np.exp(-20 * 140 / 255)), rtol=1e-4)
    found = to_full_size(image, mask_by_model(image, Disc(100, 70, 60, 0), model, 0.5, 640, 0)) >= 0.5
    assert (found & truth).sum() / (found | truth).sum() > 0.97


def test_networks_that_cant_be_used(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("not a network")
    square = np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(UsageError, match="can't be used") as caught:
        UserModel(tmp_path / "text.onnx", 64, True).probability(square)
    assert "masks.model_side" in caught.value.remedy
    with pytest.raises(UsageError, match="does not exist"):
        Config(model=str(tmp_path / "nowhere.onnx"))


def test_other_content_is_another_setting(tmp_path: Path) -> None:
    path = write_red_detector(tmp_path / "net.onnx", 64)
    first = Config(model=str(path))
    write_red_detector(path, 64, 5.0)
    assert first.model_sha256 != Config(model=str(path)).model_sha256 and len(first.model_sha256) == 64
    assert Config().model_sha256 == "" == first.hair_model_sha256
    hair = Config(hair_model=str(path))
    assert len(hair.hair_model_sha256) == 64 and hair.model_sha256 == ""
    with pytest.raises(UsageError, match="does not exist") as caught:
        Config(hair_model=str(tmp_path / "nowhere.onnx"))
    assert caught.value.where == "masks.hair_model"


def test_one_class_of_several(tmp_path: Path) -> None:
    """Oracle: the softmax of what a 1 x 1 convolution gives, by hand; probabilities stay what they are."""
    rows = [(0.0, 0.0, 0.0), (9.0, -9.0, 0.0), (0.0, 4.0, 1.0)]
    path = write_network(tmp_path / "net.onnx", 32, rows)
    square = np.full((32, 32, 3), (200, 60, 60), np.uint8)
    values = np.exp(np.array(rows) @ (np.array([200, 60, 60]) / 255))
    for k in range(3):
        found = UserModel(path, 32, False, k).probability(square)
        np.testing.assert_allclose(found, values[k] / values.sum(), rtol=1e-4)
    even = write_network(tmp_path / "even.onnx", 32, [(0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5)])
    share = 200 / 320
    np.testing.assert_allclose(UserModel(even, 32, False, 0).probability(square), share, rtol=1e-4)
    with pytest.raises(UsageError, match="can't be used") as caught:
        UserModel(path, 32, False, 3, "masks.hair_model").probability(square)
    assert "masks.hair_model" in caught.value.where and "at least 4" in caught.value.limit
    with pytest.raises(UsageError, match="can't be used"):
        UserModel(path, 32, False).probability(square)  # three classes, and none chosen


def test_the_settings_name_the_networks(tmp_path: Path) -> None:
    """Each setting reaches its own network; nothing is made where none is named."""
    path = write_red_detector(tmp_path / "net.onnx", 64)
    assert user_model(Config()) is None and hair_model(Config()) is None
    own = Config(model=str(path), model_side=64, model_imagenet=True, hair_model_imagenet=False)
    assert user_model(own) == UserModel(path, 64, True) and hair_model(own) is None
    hair = Config(hair_model=str(path), hair_model_side=96, hair_model_imagenet=True, hair_model_class=2)
    assert hair_model(hair) == UserModel(path, 96, True, 2, "masks.hair_model") and user_model(hair) is None
    only = hair_model(Config(hair_model=str(path)))
    assert only is not None and only.of_class is None
