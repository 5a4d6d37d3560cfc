"""Pictures to files and back: bit depth, channels, order, and files that are not pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from pipeline import images
from pipeline.colour import linear_from_srgb
from pipeline.errors import StageError


def codes(bits: int, channels: int) -> np.ndarray:
    peak = 2**bits - 1
    return np.random.default_rng(0).integers(0, peak + 1, (7, 5, channels)) / peak


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_round_trip_is_exact(tmp_path: Path, bits: int, channels: int) -> None:
    data = codes(bits, channels)
    images.write_png(tmp_path / "a.png", data, bits)
    back = images.read_encoded(tmp_path / "a.png")
    assert back.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.array_equal(back / (2**bits - 1), data)


def test_png_is_rgb_in_the_file(tmp_path: Path) -> None:
    """Seen by another reader: a red pixel is red."""
    images.write_png(tmp_path / "a.png", np.array([[[1.0, 0.5, 0.0]]]))
    from PIL import Image

    assert Image.open(tmp_path / "a.png").convert("RGB").getpixel((0, 0)) == (255, 128, 0)


def test_png_clamps_and_rounds(tmp_path: Path) -> None:
    images.write_png(tmp_path / "a.png", np.array([[-1.0, 2.0, np.nan, 0.4999 / 255, 0.5001 / 255]]))
    assert images.read_encoded(tmp_path / "a.png")[0, :, 0].tolist() == [0, 255, 0, 0, 1]


def test_read_linear_decodes_integers_and_leaves_floats(tmp_path: Path) -> None:
    data = codes(8, 3)
    images.write_png(tmp_path / "a.png", data)
    assert np.abs(images.read_linear(tmp_path / "a.png") - linear_from_srgb(data)).max() < 1e-7
    images.write_exr(tmp_path / "a.exr", data.astype(np.float32) * 4)
    assert np.abs(images.read_linear(tmp_path / "a.exr") - data * 4).max() < 1e-6


def test_read_linear_of_grey_and_alpha(tmp_path: Path) -> None:
    """Grey is the same in all channels, alpha is left out and multiplies nothing."""
    grey, four = codes(8, 1), codes(8, 4)
    images.write_png(tmp_path / "g.png", grey)
    found = images.read_linear(tmp_path / "g.png")
    assert found.shape == (7, 5, 3) and np.abs(found - linear_from_srgb(grey.reshape(7, 5, 1))).max() < 1e-7
    images.write_png(tmp_path / "a.png", four)
    found = images.read_linear(tmp_path / "a.png")
    assert found.shape == (7, 5, 3) and np.abs(found - linear_from_srgb(four[..., :3])).max() < 1e-7


def test_write_png_from_linear_is_srgb(tmp_path: Path) -> None:
    images.write_png_from_linear(tmp_path / "a.png", np.full((1, 1, 3), 0.21404114, np.float32))
    assert images.read_encoded(tmp_path / "a.png").ravel().tolist() == [128] * 3  # half grey


def test_read_alpha(tmp_path: Path) -> None:
    rgba = codes(8, 4)
    images.write_png(tmp_path / "a.png", rgba)
    assert np.allclose(images.read_alpha(tmp_path / "a.png"), rgba[..., 3])
    images.write_png(tmp_path / "m.png", codes(16, 1), 16)
    assert np.allclose(images.read_alpha(tmp_path / "m.png"), codes(16, 1)[..., 0])


def test_read_alpha_of_opaque_pictures(tmp_path: Path) -> None:
    """Of a grey one its values, of a coloured one the alpha: it shows a subject that fills the frame."""
    for bits in (8, 16):
        grey, colours = codes(bits, 1), codes(bits, 3)
        opaque = np.ones_like(grey)
        images.write_png(tmp_path / "g.png", np.concatenate([grey, grey, grey, opaque], 2), bits)
        assert np.allclose(images.read_alpha(tmp_path / "g.png"), grey[..., 0])
        images.write_png(tmp_path / "c.png", np.concatenate([colours, opaque], 2), bits)
        assert (images.read_alpha(tmp_path / "c.png") == 1).all()


@pytest.mark.parametrize("channels", [1, 3, 4, 6])
def test_exr_round_trip(tmp_path: Path, channels: int) -> None:
    data = np.random.default_rng(1).normal(0, 100, (6, 9, channels)).astype(np.float32)
    data[0, 0] = 1e30
    images.write_exr(tmp_path / "sub" / "a.exr", data)
    back, names = images.read_exr(tmp_path / "sub" / "a.exr")
    assert np.array_equal(back, data)
    assert names == {1: ("Y",), 3: tuple("RGB"), 4: tuple("RGBA")}.get(channels, tuple(f"c{i}" for i in range(6)))


def test_half_exr_is_close(tmp_path: Path) -> None:
    data = np.random.default_rng(2).uniform(0, 4, (6, 9, 3)).astype(np.float32)
    images.write_exr(tmp_path / "a.exr", data, half=True)
    back, _ = images.read_exr(tmp_path / "a.exr")
    assert 0 < np.abs(back - data).max() < 4 * 2**-11


def test_steps_are_the_nearest_ones_and_take_less_room(tmp_path: Path) -> None:
    data = np.random.default_rng(5).normal(0, 1, (64, 64, 3)).astype(np.float32)
    images.write_exr(tmp_path / "whole.exr", data)
    for half in (False, True):
        images.write_exr(tmp_path / "steps.exr", data, step=2**-7, half=half)
        found = images.read_exr(tmp_path / "steps.exr")[0]
        assert np.array_equal(found * 128, np.round(found * 128)) and 0 < np.abs(found - data).max() <= 2**-8
        assert (tmp_path / "steps.exr").stat().st_size < 0.7 * (tmp_path / "whole.exr").stat().st_size


def test_half_floats_never_become_infinite(tmp_path: Path) -> None:
    """65504 is the largest; below 6e-5 the steps no longer shrink, and a NaN stays one."""
    data = np.array([[1e9, -np.inf, 65504, 1e-7], [np.nan, 0, 0.1, -2]], np.float32)[..., None]
    images.write_exr(tmp_path / "a.exr", data, half=True)
    found = images.read_exr(tmp_path / "a.exr")[0][..., 0]
    assert found[0].tolist() == pytest.approx([65504, -65504, 65504, 1e-7], rel=1e-3, abs=6e-8)
    assert np.isnan(found[1, 0]) and found[1, 1:].tolist() == pytest.approx([0, 0.1, -2], rel=2**-11)


def test_exr_is_what_another_reader_finds(tmp_path: Path) -> None:
    data = np.random.default_rng(3).uniform(0, 1, (4, 3, 3)).astype(np.float32)
    images.write_exr(tmp_path / "a.exr", data)
    channels = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    assert all(np.array_equal(channels[n].pixels, data[..., i]) for i, n in enumerate("RGB"))


def test_an_exr_photo_with_more_channels_gives_its_colour(tmp_path: Path) -> None:
    data = np.random.default_rng(4).uniform(0, 1, (4, 3, 5)).astype(np.float32)
    images.write_exr(tmp_path / "a.exr", data, ("R", "G", "B", "A", "depth"))
    assert np.array_equal(images.read_encoded(tmp_path / "a.exr"), data[..., :4])


@pytest.mark.parametrize(("names", "taken"), [
    (("R", "G", "B", "beauty.B", "beauty.G", "beauty.R"), "R G B"),  # the plain ones before those of a layer
    (("beauty.B", "beauty.G", "beauty.R", "Z"), "beauty.R beauty.G beauty.B"),
    (("Z", "a.A", "a.B", "a.G", "a.R"), "a.R a.G a.B a.A"),
    (("A", "b", "g", "r"), "r g b A"),
    (("left.beauty.b", "left.beauty.g", "left.beauty.r"), "left.beauty.r left.beauty.g left.beauty.b"),
    (("Y", "A"), "Y"),
    (("A", "Y", "Z"), "Y"),
    (("A",), "A"),
    (("depth.V",), "depth.V"),
])  # fmt: skip
def test_which_channels_of_an_exr_are_its_picture(tmp_path: Path, names: tuple[str, ...], taken: str) -> None:
    data = np.random.default_rng(5).uniform(0, 1, (4, 3, len(names))).astype(np.float32)
    images.write_exr(tmp_path / "a.exr", data, names)
    found = images.read_encoded(tmp_path / "a.exr")
    assert np.array_equal(found, data[..., [names.index(n) for n in taken.split()]])


@pytest.mark.parametrize("names", [
    ("Z", "depth", "id", "x", "y"), ("A", "Z"), ("G", "B", "A"), ("R", "G"),
    ("a.R", "a.G", "a.B", "b.R", "b.G", "b.B"),
])  # fmt: skip
def test_channels_of_an_exr_that_are_no_picture_are_named(tmp_path: Path, names: tuple[str, ...]) -> None:
    images.write_exr(tmp_path / "a.exr", np.ones((4, 3, len(names)), np.float32), names)
    with pytest.raises(StageError, match="pixel format is not supported") as e:
        images.read_encoded(tmp_path / "a.exr")
    assert all(n in str(e.value.value) for n in names) and "diffuse.R" in str(e.value.limit)


def test_wrong_number_of_channel_names(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 channel names for 3"):
        images.write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3), np.float32), ("a", "b"))


def cut_off(path: Path) -> None:
    if path.suffix == ".png":
        images.write_png(path, codes(8, 3))
    else:
        images.write_exr(path, codes(8, 3).astype(np.float32))
    path.write_bytes(path.read_bytes()[:30])


@pytest.mark.parametrize("fault", ["missing", "empty", "text", "cut"])
@pytest.mark.parametrize("kind", ["png", "exr"])
def test_files_that_are_no_pictures(tmp_path: Path, fault: str, kind: str) -> None:
    path = tmp_path / f"photo.{kind}"
    if fault == "empty":
        path.write_bytes(b"")
    elif fault == "text":
        path.write_text("not a picture")
    elif fault == "cut":
        cut_off(path)
    with pytest.raises(StageError, match="can't be decoded") as e:
        images.read_encoded(path)
    assert e.value.where == path.name


def test_a_picture_that_is_far_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "MAX_PIXELS", 34)
    images.write_png(tmp_path / "a.png", codes(8, 3))
    with pytest.raises(StageError, match="too large"):
        images.read_encoded(tmp_path / "a.png")


def test_shrink_is_the_mean_over_blocks() -> None:
    data = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert images.shrink(data, 2).tolist() == [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]]
    assert np.allclose(images.shrink(np.stack([data, 2 * data], -1), 2)[..., 1], 2 * images.shrink(data, 2))
    assert images.shrink(data, 1) is data
    with pytest.raises(ValueError, match="not a multiple of 4"):
        images.shrink(data, 4)


def test_exr_headers_say_what_the_numbers_are(tmp_path: Path) -> None:
    import OpenEXR

    from pipeline.colour import ACESCG, REC709

    rgb = np.zeros((2, 2, 3), np.float32)
    images.write_exr(tmp_path / "a.exr", rgb)
    images.write_exr(tmp_path / "b.exr", rgb, primaries=ACESCG)
    images.write_exr(tmp_path / "c.exr", rgb, primaries=None)
    images.write_exr(tmp_path / "d.exr", rgb[..., :1], units="mm")
    headers = {}
    for name in "abcd":
        with OpenEXR.File(str(tmp_path / f"{name}.exr")) as f:
            headers[name] = dict(f.header())  # emptied when the file closes
    np.testing.assert_allclose(headers["a"]["chromaticities"], REC709, atol=1e-6)
    np.testing.assert_allclose(headers["b"]["chromaticities"], ACESCG, atol=1e-6)
    assert "chromaticities" not in headers["c"] and "chromaticities" not in headers["d"]
    assert headers["d"]["units"] == "mm" and "units" not in headers["a"]
    assert all(h["software"] == images.SOFTWARE for h in headers.values())
