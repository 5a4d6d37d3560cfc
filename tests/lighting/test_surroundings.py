"""What photos show behind the subject: the room of which they are taken comes back, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.lighting.surroundings import Backdrop, Surroundings, surroundings
from pipeline.maths.latlong import latlong_directions
from pipeline.transforms import rays

SIDE, FOCAL = 120, 110.0
LENS = np.array([-0.04, 0.01, 0.001, -0.001, 0.0])


def room(d: np.ndarray) -> np.ndarray:
    """(..., 3) radiance of a smooth room in unit directions (..., 3)."""
    x, y, z = np.moveaxis(d, -1, 0)
    return np.stack([0.3 + 0.2 * x, 0.3 + 0.1 * y + 0.1 * z, 0.25 + 0.2 * z * x], -1)


def pose(degrees: float, height: float = 0.0) -> np.ndarray:
    """A camera around the origin that looks at it, OpenCV axes."""
    a = np.radians(degrees)
    eye = np.array([np.sin(a), height, np.cos(a)])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = np.stack([right, np.cross(forward, right), forward], 1), eye
    return out


def photo(at: np.ndarray, seed: int = 0, response: np.ndarray | None = None, subject: float = 25.0) -> Backdrop:
    """A photo of the room with a disc of the subject in its middle."""
    K = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    d = rays(K, at, LENS, np.stack([column.ravel(), row.ravel()], 1))[1].reshape(SIDE, SIDE, 3)
    response = np.eye(3) if response is None else response
    rgb = room(d) @ response.T + np.random.default_rng(seed).normal(0, 0.003, d.shape)
    alpha = np.hypot(row - SIDE / 2, column - SIDE / 2) < subject
    rgb[alpha] = 5.0
    return Backdrop(rgb.clip(0).astype(np.float32), alpha.astype(np.float32), None, K, at, LENS, response)


def ring(**options: float) -> list[Backdrop]:
    return [
        photo(pose(a, h), n, **options)
        for n, (a, h) in enumerate((a, h) for a in range(0, 360, 30) for h in (-0.4, 0.3))
    ]


def errors(found: Surroundings, away: float = 1e-4) -> np.ndarray:
    """Relative errors in the directions that photos show, and that are nearer to them than `away`."""
    truth, near = room(latlong_directions(found.radiance.shape[1], len(found.radiance))), found.away < away
    return np.abs(found.radiance - truth)[near] / truth[near]


def test_the_room_comes_back_in_the_directions_that_photos_show() -> None:
    found = surroundings(ring())
    assert found is not None and 0.4 < found.facts()["known"] < 0.95
    assert np.quantile(errors(found), 0.99) < 0.04 and np.median(errors(found)) < 0.01
    assert errors(found, np.radians(4)).max() < 0.1
    up = np.argmax(latlong_directions(256, 128)[..., 1].ravel())
    assert found.share.ravel()[up] == 0 and found.away.ravel()[up] > np.radians(20)


def test_each_photos_colours_are_undone() -> None:
    rng = np.random.default_rng(1)
    turned = [photo(p.world_from_cam, n, np.diag(rng.uniform(0.6, 1.6, 3)) + 0.03) for n, p in enumerate(ring())]
    found = surroundings(turned)
    assert found is not None and np.quantile(errors(found), 0.99) < 0.05
    ignored = surroundings([replace(p, response=np.eye(3)) for p in turned])
    assert ignored is not None and np.median(errors(ignored)) > 0.05


def test_the_lens_counts() -> None:
    """A bright stripe near the frame's edge lies where the distorted ray through it points."""
    lens = np.array([0.4, 0.0, 0.0, 0.0, 0.0])
    K = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    row, column = np.mgrid[:SIDE, :SIDE] + 0.5
    d = rays(K, pose(0), lens, np.stack([column.ravel(), row.ravel()], 1))[1].reshape(SIDE, SIDE, 3)
    right = d @ pose(0)[:3, 0] > 0.38
    alpha = (np.hypot(row - SIDE / 2, column - SIDE / 2) < 10).astype(np.float32)
    rgb = (0.1 + 0.8 * right[..., None] + np.random.default_rng(0).normal(0, 0.003, d.shape)).astype(np.float32)
    found = surroundings([Backdrop(rgb, alpha, None, K, pose(0), lens, np.eye(3))])
    assert found is not None
    shown = found.away < 1e-4
    bright = latlong_directions(256, 128) @ pose(0)[:3, 0] > 0.38
    assert ((found.radiance[..., 0] > 0.5) == bright)[shown].mean() > 0.98


def test_a_hand_in_one_photo_does_not_count() -> None:
    photos = [photo(pose(a), n) for n, a in enumerate((0, 4, 8, 12, 16))]
    photos[2].rgb[:, :40] = 0.9
    found = surroundings(photos)
    assert found is not None and np.quantile(errors(found), 0.9) < 0.03


def test_clipped_places_are_told_and_are_not_known() -> None:
    def bright(p: Backdrop) -> Backdrop:
        K, d = p.K, p.world_from_cam
        row, column = np.mgrid[:SIDE, :SIDE] + 0.5
        ray = rays(K, d, LENS, np.stack([column.ravel(), row.ravel()], 1))[1].reshape(SIDE, SIDE, 3)
        window = (ray @ (0, 0, -1) > 0.97) & (p.alpha == 0)
        return replace(
            p, rgb=np.where(window[..., None], 1, p.rgb).astype(np.float32), clipped=window.astype(np.float32)
        )

    found = surroundings([bright(photo(pose(a, h), subject=12)) for a in (-20, -10, 10, 20) for h in (-0.2, 0.2)])
    assert found is not None
    middle = found.clipped[64, 0] > 0.5, found.share[64, 0]  # -Z
    assert middle[0] and middle[1] == 0 and 0.005 < found.facts()["clipped"] < 0.03
    none = surroundings([replace(bright(photo(pose(a), subject=12)), clipped=None) for a in (-20, 0, 20)])
    assert none is not None and none.facts()["clipped"] == 0


def test_a_narrow_gap_goes_on_and_a_wide_one_is_unknown() -> None:
    found = surroundings([photo(pose(0), subject=5), photo(pose(90), subject=45)])
    assert found is not None
    assert found.share[64, 0] > 0.9  # -Z, behind a disc of 2.6 degrees
    assert found.share[64, 192] == 0 and found.away[64, 192] > np.radians(15)  # -X, behind one of 22


@pytest.mark.parametrize("colour", [0.0, 0.4, 1.0])
def test_a_painted_background_says_nothing(colour: float) -> None:
    def painted(p: Backdrop) -> Backdrop:
        return replace(p, rgb=np.where(p.alpha[..., None] > 0, p.rgb, colour).astype(np.float32))

    assert surroundings([painted(p) for p in ring()]) is None
    noise = np.random.default_rng(0).normal(0, 0.01, (SIDE, SIDE, 3)).astype(np.float32)
    noisy = [replace(painted(p), rgb=(painted(p).rgb + noise).clip(0, 1)) for p in ring()]
    assert colour == 0 or surroundings(noisy) is not None


def test_photos_that_contradict_each_other_say_nothing() -> None:
    still = photo(pose(0))  # a camera that stands still before a subject that turns
    pattern = (0.02 + 0.9 * (np.mgrid[:SIDE, :SIDE][1][..., None] > 60) + 0.002 * still.rgb).astype(np.float32)
    turning = [replace(still, rgb=pattern, world_from_cam=pose(a, h)) for a in range(0, 360, 8) for h in (-0.5, 0, 0.5)]
    assert surroundings(turning) is None


def test_nothing_is_said_where_photos_show_only_the_subject() -> None:
    assert surroundings([]) is None
    assert surroundings([replace(p, alpha=np.ones_like(p.alpha)) for p in ring()]) is None
    corner = photo(pose(0))
    corner.alpha[:-12, :] = corner.alpha[:, :-12] = 1
    assert surroundings([corner]) is None


def test_how_well_photos_see_a_normal_is_the_mean_of_cosines() -> None:
    poses = [pose(0), pose(60, 0.3)]
    found = surroundings([photo(p) for p in poses])
    assert found is not None
    d = latlong_directions(256, 128)
    expected = np.mean([np.maximum(d @ -p[:3, 2], 0) for p in poses], 0)
    np.testing.assert_allclose(found.facing, expected, atol=1e-6)


def test_it_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = surroundings(ring())
    assert found is not None
    found.save(tmp_path / "x.npz")
    again = Surroundings.load(tmp_path / "x.npz")
    for name in ("radiance", "away", "clipped", "facing"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))
