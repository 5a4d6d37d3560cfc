"""Corneas and their glints: on a made-up light stage whose pictures show reflections at places known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.artifacts import Camera, Located, MaskSet, ViewMask
from pipeline.camera import PinholeCamera
from pipeline.contract import Context
from pipeline.errors import StageError
from pipeline.eyes.mirror import Cornea, reflected
from pipeline.images import read_linear, write_exr, write_png
from pipeline.meshes import unit
from pipeline.transforms import rows
from stages.reflectance.deform import moved
from stages.reflectance.field import Field, Lamp, distant_lamp, load, save
from stages.reflectance.find_corneas import bright_spots, find_corneas, lids_of
from stages.reflectance.glints import glints
from stages.reflectance.relight import lit_by, look_up, picture
from stages.reflectance.rig import Rig, rig_of
from stages.reflectance.score import camera_at
from tests.reflectance.test_field import field_of
from tests.reflectance.test_rig_and_motion import lights_of
from tests.support.light_stage import DISTANCE, make_stage
from tests.support.textured_ball import camera_on_orbit

SIDE = 96
K = np.array([[1500.0, 0, SIDE / 2], [0, 1500.0, SIDE / 2], [0, 0, 1]])
CENTRE, RADIUS, F0 = np.array([0.001, -0.002, 0.0935]), 0.0076, 0.035
FRONT = np.array([0, 0, 0.1])
LIDS = 0.0055  # metres around the middle of the eye
LAMP = Lamp(np.array([0.2, 0.3, 1.25]), -unit(np.array([[0.2, 0.3, 1.25]]))[0], np.array([4.0, 3.0, 2.0]))


def rig() -> Rig:
    """Three cameras that look at the front of a ball, and 60 lamps all around."""
    stage = make_stage(3, 60)
    poses = [camera_on_orbit(a, e, 0.9, FRONT) for a, e in ((-18, 4), (2, 8), (20, -3))]
    cameras = [Camera(index=i, name=str(i), width=SIDE, height=SIDE, K=rows(K), world_from_cam=rows(p),
                      distortion=(0,) * 5) for i, p in enumerate(poses)]  # fmt: skip
    return rig_of(lights_of(stage), cameras, np.eye(4), {})


def lids(own: Rig) -> dict[int, np.ndarray]:
    """Discs around the middle of the eye."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    out = {}
    for c in range(len(own.cameras)):
        (u, v), depth = (part[0] for part in own.pixels(c, 0, FRONT[None]))
        out[c] = np.hypot(x - u, y - v) < LIDS * K[0, 0] / depth
    return out


def with_cornea(field: Field) -> Field:
    normals = unit(np.random.default_rng(1).normal(size=(4000, 3)) + [0, 0, 2])
    return field.with_corneas((Cornea(CENTRE, RADIUS, F0, normals, np.ones(len(normals))),))


def photographs(folder: Path, own: Rig, field: Field, *, noise: float = 2e-3, distractors: int = 2, shown: bool = True):
    """A grey eye with glints, sensor noise and bright spots that are none, under each light."""
    rng = np.random.default_rng(5)
    masks, out = lids(own), {}
    positions, axes = own.lamps()
    for c in range(len(own.cameras)):
        inside = np.argwhere(masks[c])
        for i in range(len(own.index)):
            lamp, view = Lamp(positions[i], axes[i], own.strength[i]), camera_at(own, c, i)
            image = np.full((SIDE, SIDE, 3), 0.05) + rng.normal(0, noise, (SIDE, SIDE, 3))
            image += glints(field, view, lamp) * masks[c][..., None] if shown else 0
            for y, x in inside[rng.integers(len(inside), size=distractors)]:
                image[y : y + 2, x : x + 2] += rng.uniform(0.05, 0.6)
            out[c, i] = folder / f"{c}_{i}.exr"
            write_exr(out[c, i], image.astype(np.float32))
    return out


@pytest.fixture(scope="module")
def field() -> Field:
    return with_cornea(field_of(np.array([0.5, 0.4, 0.3])))


def test_a_cornea_is_found_by_its_glints(field: Field, tmp_path: Path) -> None:
    """Oracle: the sphere that made the glints. The start is the ball's surface, which is no part of it."""
    own = rig()
    found = find_corneas(field, own, photographs(tmp_path, own, field), lids(own), lambda *_: None)
    assert len(found) == 1
    (cornea,) = found
    assert np.linalg.norm(cornea.centre - CENTRE) < 3e-4 and abs(cornea.radius - RADIUS) < 2e-4
    assert cornea.f0 == pytest.approx(F0, rel=0.15)
    assert 15 < cornea.seen.sum() <= len(cornea.seen)
    # the lids hide the rest: there the pictures have none
    x, n = reflected(CENTRE, RADIUS, own.eyes()[0, 0], own.position)
    hidden = np.linalg.norm(x[:, :2] - FRONT[:2], axis=1) > LIDS + 0.001
    assert cornea.share(n[hidden & (n[:, 2] > 0.3)]).max(initial=0) < 0.3


def test_spots_that_are_no_glints_make_no_cornea(field: Field, tmp_path: Path) -> None:
    own = rig()
    for number, distractors in enumerate((0, 1, 4)):
        (tmp_path / str(number)).mkdir()
        pictures = photographs(tmp_path / str(number), own, field, distractors=distractors, shown=False)
        assert find_corneas(field, own, pictures, lids(own), lambda *_: None) == ()
    assert find_corneas(field, own, pictures, {}, lambda *_: None) == ()
    assert find_corneas(field, own, {}, lids(own), lambda *_: None) == ()


def test_larger_pictures_give_the_same_cornea(field: Field, tmp_path: Path) -> None:
    """Each pixel of the pictures as 3 x 3: sizes are those of the eye, not of pixels."""
    own = rig()
    pictures = photographs(tmp_path, own, field)
    (first,) = find_corneas(field, own, pictures, lids(own), lambda *_: None)
    cameras = tuple(c.model_copy(update={"width": 3 * SIDE, "height": 3 * SIDE,
                                         "K": rows(np.diag([3.0, 3, 1]) @ K)}) for c in own.cameras)  # fmt: skip
    large = {}
    for key, path in pictures.items():
        large[key] = path.with_suffix(".3.exr")
        write_exr(large[key], np.kron(read_linear(path), np.ones((3, 3, 1), np.float32)))
    masks = {c: np.kron(m, np.ones((3, 3))) > 0 for c, m in lids(own).items()}
    (second,) = find_corneas(field, replace(own, cameras=cameras), large, masks, lambda *_: None)
    np.testing.assert_allclose(second.centre, first.centre, atol=5e-5)
    assert second.f0 == pytest.approx(first.f0, rel=0.05)


def test_bright_spots_are_places_between_pixels() -> None:
    """Oracle: a Gaussian whose centre is known."""
    y, x = np.mgrid[:30, :30] + 0.5
    image = 0.2 + 0.8 * np.exp(-((x - 12.8) ** 2 + (y - 9.3) ** 2) / (2 * 0.6**2))
    places, bright = bright_spots(image.astype(np.float32), np.ones((30, 30), bool), 0.05)
    np.testing.assert_allclose(places, [[12.8, 9.3]], atol=0.06)
    assert bright[0] == pytest.approx(0.8 * 2 * np.pi * 0.6**2, rel=0.05)
    for empty in (np.zeros((30, 30), bool), y < 5):
        assert len(bright_spots(image.astype(np.float32), empty, 0.05)[0]) == 0
    assert len(bright_spots(np.full((8, 8), 1e6, np.float32), np.ones((8, 8), bool), 0.05)[0]) == 0
    corner = np.zeros((8, 8), np.float32)
    corner[0, 0] = 1
    places, _ = bright_spots(corner, np.ones((8, 8), bool), 0.05)
    np.testing.assert_allclose(places, [[0.5, 0.5]])


def test_a_glint_in_a_picture(field: Field) -> None:
    """Oracle: place and energy by hand; elsewhere the picture is that of the field without its cornea."""
    view = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT), SIDE, SIDE)
    x, n = reflected(CENTRE, RADIUS, view.eye, LAMP.position)
    own = glints(field, view, LAMP)
    local = (x[0] - view.eye) @ view.world_from_cam[:3, :3]
    at = (local / local[2] @ K.T)[:2]
    y, c = np.mgrid[:SIDE, :SIDE] + 0.5
    weight = own.sum(2) / own.sum()
    np.testing.assert_allclose([(weight * c).sum(), (weight * y).sum()], at, atol=0.02)
    far = np.linalg.norm(LAMP.position - x[0])
    energy = F0 * RADIUS**2 / 4 * LAMP.strength / far**2 * K[0, 0] ** 2 * np.linalg.norm(local) / local[2] ** 3
    np.testing.assert_allclose(own.sum((0, 1)), energy * field.corneas[0].share(n)[0], rtol=0.01)
    table, arrives = look_up(field, view), field.arrives(LAMP)
    bare = picture(view, table, lit_by(field.with_corneas(()), view, LAMP, arrives))
    shown = picture(view, table, lit_by(field, view, LAMP, arrives))
    np.testing.assert_allclose(shown[..., :3] - bare[..., :3], own, atol=1e-5)
    np.testing.assert_array_equal(shown[..., 3], bare[..., 3])


def test_where_there_is_no_glint(field: Field) -> None:
    view = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT), SIDE, SIDE)
    behind = Lamp(-LAMP.position, -LAMP.axis, LAMP.strength)
    assert (glints(field, view, behind) == 0).all()  # the ball is in the way
    back = PinholeCamera(K, camera_on_orbit(180, 8, 0.9, FRONT), SIDE, SIDE)
    assert (glints(field, back, LAMP) == 0).all()
    aside = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT + [0.2, 0, 0]), SIDE, SIDE)
    assert (glints(field, aside, LAMP) == 0).all()  # outside of the picture
    dark = Lamp(LAMP.position, LAMP.axis, np.zeros(3))
    assert (glints(field, view, dark) == 0).all()
    covered = field.with_corneas((replace(field.corneas[0], seen=np.zeros(4000)),))
    assert (glints(covered, view, LAMP) == 0).all()
    strong = Lamp(LAMP.position, LAMP.axis, 1e6 * LAMP.strength)
    np.testing.assert_allclose(glints(field, view, strong), 1e6 * glints(field, view, LAMP), rtol=1e-4)
    edge = PinholeCamera(K + [[0, 0, -SIDE / 2], [0, 0, -SIDE / 2], [0, 0, 0]], view.world_from_cam, SIDE, SIDE)
    assert np.isfinite(glints(field, edge, LAMP)).all()


def test_a_distant_lamp_glints_as_a_far_one(field: Field) -> None:
    view = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT), SIDE, SIDE)
    towards = unit(LAMP.position[None])[0]
    distant = glints(field, view, distant_lamp(towards, np.ones(3)))
    near = glints(field, view, Lamp(400 * towards, -towards, np.full(3, 400.0**2)))
    assert distant.max() > 0
    np.testing.assert_allclose(distant, near, rtol=0.02, atol=1e-4 * distant.max())


def test_a_part_of_an_environment_is_as_wide_as_it_is(field: Field) -> None:
    """Oracle: many distant lamps around a direction, as far spread: the same picture."""
    view = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT), SIDE, SIDE)
    towards = unit(LAMP.position[None])[0]
    one = glints(field, view, distant_lamp(towards, np.ones(3), 0.3))
    across = np.linalg.svd(towards[None])[2][1:]
    offsets = np.random.default_rng(2).normal(size=(1500, 2)) * 0.3
    many = sum(glints(field, view, distant_lamp(unit((towards + np.tan(o) @ across)[None])[0], np.ones(3) / 1500))
               for o in offsets)  # fmt: skip
    assert many.max() < 0.7 * glints(field, view, distant_lamp(towards, np.ones(3))).max()
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    widths = []
    for image in (one, many):
        w = image[..., 0] / image[..., 0].sum()
        widths.append(np.sqrt((w * (x - (w * x).sum()) ** 2).sum()))
    assert widths[0] == pytest.approx(widths[1], rel=0.15) and widths[0] > 1.0


def test_a_moved_head_takes_its_cornea_along(field: Field) -> None:
    """Oracle: head, lamp and camera turned together: the same picture."""
    turn = Rotation.from_euler("xyz", [10, 25, -5], degrees=True).as_matrix()
    other = moved(field, field.mesh.vertices.astype(float) @ turn.T)
    np.testing.assert_allclose(other.corneas[0].centre, turn @ CENTRE, atol=1e-5)
    pose = camera_on_orbit(5, 8, 0.9, FRONT)
    turned = pose.copy()
    turned[:3] = turn @ pose[:3]
    lamp = Lamp(turn @ LAMP.position, turn @ LAMP.axis, LAMP.strength)
    before = glints(field, PinholeCamera(K, pose, SIDE, SIDE), LAMP)
    after = glints(other, PinholeCamera(K, turned, SIDE, SIDE), lamp)
    assert before.max() > 0.1
    np.testing.assert_allclose(after, before, atol=0.01 * before.max())


def test_a_stored_field_keeps_its_corneas(field: Field, tmp_path: Path) -> None:
    save(field, tmp_path, {})
    same = load(tmp_path)
    view = PinholeCamera(K, camera_on_orbit(5, 8, 0.9, FRONT), SIDE, SIDE)
    np.testing.assert_allclose(glints(same, view, LAMP), glints(field, view, LAMP), rtol=0.02, atol=1e-4)
    path = tmp_path / "basis.json"
    path.write_text(path.read_text().replace('"radius"', '"size"'))
    with pytest.raises(StageError, match="can't be read"):
        load(tmp_path)


def test_pixels_of_eyes_by_their_label(tmp_path: Path) -> None:
    own, place = rig(), Context(tmp_path, tmp_path)
    codes = np.zeros((SIDE, SIDE, 1), np.uint8)
    codes[40:50, 30:60] = 2
    write_png(tmp_path / "a.png", codes / 255)
    write_png(tmp_path / "b.png", codes * 0.0)
    masks = tuple(ViewMask(index=i, mask=place.file(n), source="given", coverage=1, labels=place.file(n))
                  for i, n in ((0, "a.png"), (2, "b.png")))  # fmt: skip
    names = ("background", "face", "eyes")
    found = lids_of(Located(MaskSet(masks=masks, label_names=names), tmp_path), own)
    assert list(found) == [0] and found[0].sum() == 300 and found[0][45, 40]
    assert lids_of(Located(MaskSet(masks=masks, label_names=names[:2]), tmp_path), own) == {}


def test_stage_distance_is_the_lamps() -> None:
    np.testing.assert_allclose(np.linalg.norm(rig().position, axis=1), DISTANCE)
