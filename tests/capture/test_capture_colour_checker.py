"""A drawn colour chart under a known light and camera: what is found, what is made of it, when it is not believed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from skimage.color import lab2xyz

from pipeline.colour import srgb_from_linear
from pipeline.errors import StageError
from pipeline.images import read_linear, write_exr
from stages.capture import colour_matrix
from stages.capture.colour_checker import HUES, PATCHES, REFLECTANCES, Patches, find_chart, hues, places
from stages.capture.colour_correction import read_charts
from stages.capture.colour_matrix import ColourMatrix, colour_matrix_of

LAB = np.array([
    [37.986, 13.555, 14.059], [65.711, 18.13, 17.81], [49.927, -4.88, -21.925], [43.139, -13.095, 21.905],
    [55.112, 8.844, -25.399], [70.719, -33.397, -0.199], [62.661, 36.067, 57.096], [40.02, 10.41, -45.964],
    [51.124, 48.239, 16.248], [30.325, 22.976, -21.587], [72.532, -23.709, 57.255], [71.941, 19.363, 67.857],
    [28.778, 14.179, -50.297], [55.261, -38.342, 31.37], [42.101, 53.378, 28.19], [81.733, 4.039, 79.819],
    [51.935, 49.986, -14.574], [51.038, -28.631, -28.638], [96.539, -0.425, 1.186], [81.257, -0.638, -0.335],
    [66.766, -0.734, -0.504], [50.867, -0.153, -0.27], [35.656, -0.421, -1.231], [20.461, -0.079, -0.973],
])  # fmt: skip
CAMERA = np.array([[0.7, 0.1, 0.02], [0.05, 0.5, 0.05], [0.0, 0.06, 0.35]])  # photo from reflectance: warm, and mixed
QUAD = np.array([[180.0, 120], [430, 95], [445, 262], [172, 280]])
SIZE = (560, 400)
NOISE = cv2.GaussianBlur(np.random.default_rng(2).random((*SIZE[::-1], 3)), (0, 0), 4) * 0.6


def drawn(camera: np.ndarray = CAMERA, quad: np.ndarray = QUAD, shade: tuple[float, float] = (0, 0)) -> np.ndarray:
    """(H, W, 3) linear photo of a chart on a noisy ground. quad: corners in OpenCV's pixels, first patch's first.
    shade: how much brighter the light is to the right and to the bottom."""
    card = np.full((400, 580, 3), 0.02)  # patches of 80 with 20 between and around them
    x, y = np.meshgrid(np.linspace(-1, 1, 580), np.linspace(-1, 1, 400))
    for i, r in enumerate(np.maximum(REFLECTANCES, 0)):
        row, column = divmod(i, 6)
        card[row * 95 + 20 : row * 95 + 95, column * 93 + 20 : column * 93 + 95] = r
    lit = (card * (1 + shade[0] * x + shade[1] * y)[..., None]) @ camera.T
    fine = cv2.getPerspectiveTransform(np.float32([[0, 0], [580, 0], [580, 400], [0, 400]]), np.float32(quad) * 3)
    size = (SIZE[0] * 3, SIZE[1] * 3)
    over = np.dstack([cv2.warpPerspective(lit, fine, size), cv2.warpPerspective(np.ones((400, 580)), fine, size)])
    small = cv2.resize(over, SIZE, interpolation=cv2.INTER_AREA)
    return NOISE @ camera.T * (1 - small[..., 3:]) + small[..., :3]


SCENE = drawn()


def encoded(linear: np.ndarray, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1.0, linear.shape)
    return (srgb_from_linear(linear.clip(0, 1)) * 255 + noise).round().clip(0, 255).astype(np.uint8)


def write(path: Path, linear: np.ndarray, seed: int = 0) -> None:
    cv2.imwrite(str(path), encoded(linear, seed)[..., ::-1])


def close_to(matrix: object, wanted: np.ndarray) -> bool:
    return bool(np.abs(np.asarray(matrix) @ np.linalg.inv(wanted) - np.eye(3)).max() < 0.03)


def test_reflectances_are_the_makers() -> None:
    """Oracle: skimage's Lab; Bradford's matrix and the primaries of Rec.709 written out."""
    cone = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    d50, d65 = np.array([0.96422, 1, 0.82521]), np.array([0.95047, 1, 1.08883])
    adapt = np.linalg.inv(cone) @ np.diag(cone @ d65 / (cone @ d50)) @ cone
    xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    linear = lab2xyz(LAB[None], illuminant="D50")[0] @ (np.linalg.inv(xyz) @ adapt).T
    assert np.abs(linear - REFLECTANCES).max() < 5e-4


@pytest.mark.parametrize("turns", range(4))
def test_a_chart_is_found_and_says_what_the_camera_did(turns: int) -> None:
    quad = np.roll(QUAD, turns, 0) if turns % 2 == 0 else np.array([[230.0, 360], [222, 80], [408, 70], [420, 350]])
    if turns == 3:
        quad = np.roll(quad, 2, 0)
    found = find_chart(encoded(drawn(quad=quad)))
    assert found is not None and found.usable.all()
    card = np.array([[0, 0], [580, 0], [580, 400], [0, 400]], np.float32)
    edges = np.array([[[11, 10], [569, 10], [569, 390], [11, 390]]], np.float32)  # half a gap around the patches
    edges = cv2.perspectiveTransform(edges, cv2.getPerspectiveTransform(card, np.float32(quad)))[0]
    assert np.abs(found.corners - 0.5 - edges).max() < 1
    correction = colour_matrix_of(found)
    assert isinstance(correction, ColourMatrix) and correction.way == "matrix" and correction.error < 0.03
    assert close_to(correction.matrix, np.linalg.inv(CAMERA))


def test_files_of_any_depth_and_uneven_light() -> None:
    linear = drawn(shade=(0.25, -0.15))
    eight = encoded(linear)
    for image in (eight, eight.astype(np.uint16) * 257, (3 * linear).astype(np.float32)):
        found = find_chart(image)
        assert found is not None
        correction = colour_matrix_of(found)
        scale = 3 if image.dtype == np.float32 else 1
        assert isinstance(correction, ColourMatrix) and close_to(correction.matrix, np.linalg.inv(scale * CAMERA))
    assert find_chart(eight[..., :1]) is None  # a grey photo has no colours to tell
    assert find_chart(encoded(NOISE)) is None


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.9, 0.45, 0.15), (0.15, 0.3, 0.7), (0.1, 0.1, 0.1)])
def test_plain_photos_are_not_searched_and_charts_in_any_light_are(light: tuple[float, float, float]) -> None:
    thumb = cv2.resize(encoded(SCENE * light), None, fx=250 / 560, fy=250 / 560, interpolation=cv2.INTER_AREA)
    assert hues(thumb) > 1.2 * HUES
    skin = encoded(np.linspace(0.02, 0.9, 560)[:, None] * np.array([0.6, 0.4, 0.3]) * light + 1e-4)[None]
    assert hues(np.repeat(skin, 200, 0)) < HUES and hues(np.zeros((50, 50, 3), np.uint8)) == 0
    even = np.zeros((20, 20, 3), np.uint8)  # oracle: four colours by hand, each with a hundred pixels
    even[:10, :10], even[:10, 10:], even[10:, :10], even[10:, 10:] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (99, 99, 99)
    assert hues(even) == 4


def exact(camera: np.ndarray) -> Patches:
    return Patches(QUAD, REFLECTANCES @ camera.T, np.ones(PATCHES, bool))


def test_as_few_numbers_as_explain_the_chart() -> None:
    rng = np.random.default_rng(3)
    gains = exact(np.diag([0.8, 0.5, 0.3]))
    noisy = Patches(QUAD, gains.colours * rng.normal(1, 0.01, (PATCHES, 1)), gains.usable)
    found = colour_matrix_of(noisy)
    assert (
        isinstance(found, ColourMatrix) and found.way == "gains" and close_to(found.matrix, np.diag([1.25, 2, 1 / 0.3]))
    )
    mixed = colour_matrix_of(exact(CAMERA))
    assert isinstance(mixed, ColourMatrix) and mixed.way == "matrix" and mixed.error < 1e-9
    assert mixed.matrix == pytest.approx(np.linalg.inv(CAMERA))
    uneven = Patches(QUAD, exact(CAMERA).colours * (1 + places() @ [0.2, 0.1])[:, None], np.ones(PATCHES, bool))
    assert colour_matrix_of(uneven).matrix == pytest.approx(np.linalg.inv(CAMERA))


def test_clipped_patches_do_not_count_and_too_few_are_refused() -> None:
    found = find_chart(encoded(2.2 * SCENE))
    assert found is not None and not found.usable[18] and found.usable[21:].all()
    correction = colour_matrix_of(found)
    assert isinstance(correction, ColourMatrix) and correction.patches == found.usable.sum() < PATCHES
    assert close_to(correction.matrix, np.linalg.inv(2.2 * CAMERA))
    few = Patches(found.corners, found.colours, np.arange(PATCHES) < 13)
    assert "13 patches of 24" in str(colour_matrix_of(few))


def test_what_is_no_chart_is_refused() -> None:
    rng = np.random.default_rng(0)
    for _ in range(8):  # other colours, and the chart's own in another order
        for colours in (rng.random((PATCHES, 3)), REFLECTANCES[rng.permutation(PATCHES)]):
            assert "does not have" in str(colour_matrix_of(Patches(QUAD, colours, np.ones(PATCHES, bool))))
    steep = Patches(QUAD, exact(CAMERA).colours * (1 + places() @ [0.7, 0.25])[:, None], np.ones(PATCHES, bool))
    assert "unevenly" in str(colour_matrix_of(steep))


def test_all_photos_come_to_the_charts_white(tmp_path: Path, gather) -> None:
    """Two of four photos show it; the plate of one goes with its photo."""
    scene = drawn(np.eye(3))
    for i in range(4):
        write(tmp_path / f"{i}.png", SCENE if i < 2 else NOISE @ CAMERA.T, seed=i)
    (tmp_path / "clean_plate").mkdir()
    write(tmp_path / "clean_plate" / "3.png", NOISE @ CAMERA.T, seed=9)
    found = gather(tmp_path, drop_blurred=False)
    capture = found.artifact
    assert capture.chart is not None and capture.chart.photos == ("0.png", "1.png")
    (fit,) = capture.chart.fits
    assert close_to(fit.matrix, np.linalg.inv(CAMERA)) and fit.photo in capture.chart.photos
    assert 0.2 < capture.chart.level < 1
    assert fit.white == pytest.approx(CAMERA.sum(1), rel=0.03)  # of a perfect white
    for view, truth in zip(capture.views, (scene, scene, NOISE, NOISE), strict=True):
        assert view.image.path == f"photos/{view.index}_{view.index}.png" and view.exposure == 1
        shown = read_linear(found.path(view.image)) / capture.chart.level
        bright = truth > 0.1
        assert np.abs(shown[bright] / truth[bright] - 1).mean() < 0.04
        assert float((shown / truth.clip(0.02))[bright].mean()) == pytest.approx(1, abs=0.02)
    plate, photo = (read_linear(found.path(f)) for f in (capture.views[3].plate, capture.views[3].image))
    assert float(plate.mean() / photo.mean()) == pytest.approx(1, abs=0.01)
    assert sorted(p.name for p in (found.folder / "photos").iterdir()) == [f"{i}_{i}.png" for i in range(4)]


def test_a_chart_in_a_held_out_photo_is_not_used(tmp_path: Path, gather) -> None:
    for i in range(4):
        write(tmp_path / f"{i}.png", SCENE if i < 2 else NOISE @ CAMERA.T, seed=i)
    one = gather(tmp_path, holdout="names:0.png", drop_blurred=False).artifact
    assert one.chart is not None and one.chart.photos == ("1.png",)
    assert any("the colour checker in 0.png is not used" in w for w in one.warnings)
    write(tmp_path / "1.png", NOISE @ CAMERA.T, seed=8)
    assert gather(tmp_path, holdout="names:0.png", drop_blurred=False).artifact.chart is None
    with pytest.raises(StageError, match="no colour checker is found"):
        gather(tmp_path, holdout="names:0.png", drop_blurred=False, colour_checker="on")


def test_off_on_and_without_one_nothing_changes(tmp_path: Path, gather) -> None:
    for i in range(3):
        write(tmp_path / f"{i}.png", SCENE if i == 0 else NOISE @ CAMERA.T, seed=i)
    off = gather(tmp_path, colour_checker="off", drop_blurred=False)
    assert off.artifact.chart is None and [v.exposure for v in off.artifact.views] == [1, 1, 1]
    assert off.path(off.artifact.views[0].image).read_bytes() == (tmp_path / "0.png").read_bytes()
    assert gather(tmp_path, colour_checker="on", drop_blurred=False).artifact.chart is not None
    write(tmp_path / "0.png", NOISE @ CAMERA.T, seed=7)
    auto = gather(tmp_path)
    assert auto.artifact.chart is None and not auto.artifact.warnings
    assert auto.path(auto.artifact.views[0].image).read_bytes() == (tmp_path / "0.png").read_bytes()
    with pytest.raises(StageError, match="no colour checker is found") as caught:
        gather(tmp_path, colour_checker="on")
    assert "capture.colour_checker=auto" in str(caught.value)


def test_a_chart_that_is_none_is_named(tmp_path: Path, gather, monkeypatch) -> None:
    for i in range(3):
        write(tmp_path / f"{i}.png", NOISE, seed=i)
    wrong = Patches(QUAD, np.random.default_rng(1).random((PATCHES, 3)), np.ones(PATCHES, bool))
    monkeypatch.setattr("stages.capture.import_photo.find_chart", lambda image: wrong)
    found = gather(tmp_path).artifact
    assert found.chart is None
    assert "1.png: the colour checker does not have" in "; ".join(found.warnings)
    with pytest.raises(StageError, match=r"0\.png"):
        gather(tmp_path, colour_checker="on")


def test_float_files_stay_float_and_cameras_have_maps_of_their_own(tmp_path: Path, gather) -> None:
    """The first camera saw it, the second (another size) did not and gets the first one's map."""
    for i in range(3):
        write_exr(tmp_path / f"{i}.exr", (2 * SCENE + 1e-4 * i).astype(np.float32))
    write_exr(tmp_path / "3.exr", (2 * NOISE[:300] @ CAMERA.T).astype(np.float32))
    found = gather(tmp_path, drop_blurred=False)
    views, chart = found.artifact.views, found.artifact.chart
    assert chart is not None and [f.camera_group for f in chart.fits] == ["560x400"]
    assert [v.exposure for v in views] == [1] * 4 and views[3].camera_group == "560x300"
    for view, truth in ((views[0], drawn(np.eye(3))), (views[3], NOISE[:300])):
        assert view.image.path.endswith(".exr")
        shown = read_linear(found.path(view.image)) / chart.level
        assert float(np.abs(shown - truth).max()) < 0.03


def test_of_a_cameras_charts_the_best_counts_at_its_photos_exposure() -> None:
    """The same chart three times: at twice and at half the exposure, and with noise."""
    rng, known = np.random.default_rng(6), exact(CAMERA)
    noisy = known.colours * rng.normal(1, 0.03, (PATCHES, 3))
    colours = [2.0 * noisy, 0.5 * known.colours, noisy]
    views: Any = [
        SimpleNamespace(name=f"{i}.png", camera_group="one", exposure=e, index=i) for i, e in enumerate((2.0, 0.5, 1.0))
    ]
    chart = read_charts(views, [Patches(QUAD, c, known.usable) for c in colours], wanted=True).chart
    assert chart is not None and chart.photos == ("0.png", "1.png", "2.png")
    (fit,) = chart.fits
    assert fit.photo == "1.png" and fit.error < 1e-6
    np.testing.assert_allclose(np.array(fit.matrix).reshape(3, 3), np.linalg.inv(CAMERA), atol=1e-5)


@pytest.mark.parametrize("diagonal", [True, False])
def test_the_error_is_that_of_patches_that_were_left_out(diagonal: bool) -> None:
    """Against the closed form of least squares: what a block of rows is off by without itself is (1 - H)^-1 of what it
    is off by with itself, H the block of the hat matrix."""
    rng = np.random.default_rng(8)
    found = Patches(QUAD, exact(CAMERA).colours * rng.normal(1, 0.05, (PATCHES, 3)), np.ones(PATCHES, bool))
    count = 3 if diagonal else 9
    rows, y = np.zeros((PATCHES, 3, count + 2)), np.zeros((PATCHES, 3))
    for i, (c, r, at) in enumerate(zip(found.colours, REFLECTANCES, places(), strict=True)):
        weight = 1 / (r @ [0.2126, 0.7152, 0.0722] + 0.1)
        linear = np.diag(c) if diagonal else np.kron(np.eye(3), c[None])
        rows[i], y[i] = weight * np.hstack([linear, -r[:, None] * at]), weight * r
    flat = rows.reshape(-1, count + 2)
    hat = flat @ np.linalg.pinv(flat)
    off = (hat @ y.ravel() - y.ravel()).reshape(PATCHES, 3)
    blocks = [hat[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(PATCHES)]
    without = np.stack([np.linalg.solve(np.eye(3) - h, e) for h, e in zip(blocks, off, strict=True)])
    assert colour_matrix._left_out(found, diagonal) == pytest.approx(float(np.sqrt((without**2).mean())), rel=1e-6)
