"""The frames of a moving light, and rotated harmonics, against numpy and directly evaluated lights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.maths import sh
from pipeline.maths.light_frame import CAMERA, FLASH, NEAREST, TURNTABLE, Stations, lamp_axes, level_axes, turn_of

RNG = np.random.default_rng(3)


def cameras(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres and axes of cameras about 1 from the origin that look at it, rolled at random."""
    eye = RNG.normal(size=(count, 3))
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    axes = []
    for e in eye:
        x = np.cross(-e, RNG.normal(size=3))
        x /= np.linalg.norm(x)
        axes.append(np.stack([x, np.cross(-e, x), -e], 1))
    return eye, np.array(axes)


def towards(x: np.ndarray, eye: np.ndarray) -> np.ndarray:
    away = eye - x
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(a, np.float64)) for a in arrays]


def test_a_camera_s_frame_is_its_axes() -> None:
    eye, axes = cameras(5)
    x, d = 0.1 * RNG.normal(size=(5, 3)), RNG.normal(size=(5, 3))
    e, a, at, direction = tensors(eye, axes, x, d)
    turn = turn_of(CAMERA, Stations(e, a), at, torch.from_numpy(towards(x, eye)), 1.0)
    np.testing.assert_allclose(turn(direction), np.stack([m.T @ v for m, v in zip(axes, d, strict=True)]), atol=1e-12)
    assert (turn.strength == 1).all()


def test_a_lamp_at_the_lens_has_one_direction_everywhere() -> None:
    """A point light at the camera's centre: towards it is -z at every point, and E falls off with d^2."""
    eye, axes = cameras(200)
    x = 0.3 * RNG.normal(size=(200, 3)).clip(-1, 1)
    to_lamp, distance = towards(x, eye), np.linalg.norm(eye - x, axis=1)
    e, a, at, wo = tensors(eye, axes, x, to_lamp)
    turn = turn_of(FLASH, Stations(e, a), at, wo, 0.8)
    np.testing.assert_allclose(turn(wo).numpy(), np.tile([0, 0, -1.0], (200, 1)), atol=1e-6)
    np.testing.assert_allclose(turn.strength[:, 0].numpy(), (0.8 / distance) ** 2, rtol=1e-9)
    frames = turn.axes.numpy()
    np.testing.assert_allclose(np.einsum("nij,nik->njk", frames, frames), np.tile(np.eye(3), (200, 1, 1)), atol=1e-6)
    assert np.linalg.det(frames).min() > 0.99


def test_on_the_optical_axis_the_lamp_s_frame_is_the_camera_s() -> None:
    eye, axes = cameras(4)
    a, wo = tensors(axes, towards(np.zeros((4, 3)), eye))
    np.testing.assert_allclose(lamp_axes(a, wo).numpy(), axes, atol=1e-6)


def test_a_turntable_s_frame_turns_with_the_subject_alone() -> None:
    """The subject turns by any angle about its vertical, the camera is raised or lowered: a lamp of the room keeps its
    direction in the frame."""
    lamp = np.array([0.4, 0.5, 0.7])
    found = []
    for azimuth in (0.0, 40.0, 170.0, -100.0):
        turned = Rotation.from_euler("y", azimuth, degrees=True)
        for elevation in (-50.0, 0.0, 30.0, 80.0):
            tilt = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_euler("x", -elevation, degrees=True).as_matrix()
            (axes,) = tensors((turned.as_matrix() @ tilt)[None])
            frame = level_axes(axes)[0].numpy()
            np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-6)
            assert np.linalg.det(frame) > 0.99
            found.append(frame.T @ turned.apply(lamp))  # the room turns with the camera around the subject
    np.testing.assert_allclose(found, np.tile(found[0], (len(found), 1)), atol=1e-6)
    # in front and level: x to the picture's right, y down, z away from the camera
    np.testing.assert_allclose(found[0], lamp * [1, -1, -1], atol=1e-6)


def test_a_camera_that_looks_straight_down_has_a_level_frame() -> None:
    """By the picture's upward direction."""
    axes = np.array([[[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]]).transpose(0, 2, 1)  # columns right, down, forward
    axes[0, :, 1], axes[0, :, 2] = [0, 0, 1.0], [0, -1.0, 0]
    (a,) = tensors(axes)
    np.testing.assert_allclose(level_axes(a)[0, :, 2].numpy(), [0, 0, -1], atol=1e-6)
    eye, _ = cameras(1)
    turn = turn_of(TURNTABLE, Stations(torch.from_numpy(eye), a), 0 * torch.from_numpy(eye), a[:, :, 0], 1.0)
    assert (turn.strength == 1).all()


def test_extremes_stay_finite() -> None:
    """A point at the lens, and one at right angles to the optical axis."""
    eye, axes = cameras(2)
    x = np.stack([eye[0], eye[1] + axes[1, :, 0]])
    e, a, at = tensors(eye, axes, x)
    wo = torch.from_numpy(np.stack([-axes[0, :, 2], -axes[1, :, 0]]))
    turn = turn_of(FLASH, Stations(e, a), at, wo, 1.0)
    assert turn.axes.isfinite().all() and turn.strength.isfinite().all()
    assert float(turn.strength.max()) == pytest.approx(NEAREST**-2)


@pytest.mark.parametrize("order", [0, 1, 4, 10])
def test_rotated_harmonics_are_the_light_in_turned_directions(order: int) -> None:
    c = RNG.normal(size=(sh.count(order), 3))
    axes = Rotation.random(random_state=5).as_matrix()
    d = RNG.normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    turned = sh.rotated(c, axes)
    at = [sh.radiance(*tensors(*pair)).numpy() for pair in ((turned, d), (c, d @ axes))]
    np.testing.assert_allclose(at[0], at[1], atol=1e-10)
    for band in range(order + 1):  # a rotation keeps the energy of each band
        own = slice(band * band, (band + 1) ** 2)
        np.testing.assert_allclose(np.linalg.norm(turned[own]), np.linalg.norm(c[own]), rtol=1e-10)
    np.testing.assert_allclose(sh.rotated(turned, axes.T), c, atol=1e-10)


def test_the_spiral_is_even() -> None:
    """Means of harmonics over it vanish from band 1 on."""
    basis = sh.sh_basis(torch.from_numpy(sh.spiral(2000)), 4).numpy()
    np.testing.assert_allclose(basis.mean(0)[1:], 0, atol=2e-3)
