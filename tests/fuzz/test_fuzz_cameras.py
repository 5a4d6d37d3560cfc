"""Damaged descriptions of cameras: a named error, or cameras that are ones. Never a traceback, a hang, or nonsense."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given

from stages.capture.readers import describe, find_reader
from stages.capture.readers.cameras import FARTHEST, FOCAL
from stages.capture.readers.olat import LIGHTS, read_lights
from stages.capture.scan import scan_capture
from tests.capture.test_capture_readers import CAMS, SIZE, F, colmap, metashape, pictures, realityscan, transforms
from tests.support.facescape_tree import write_tree
from tests.support.fuzzing import bounded, fuzzed, halved
from tests.support.light_stage import make_stage, write_lights
from tests.support.mutations import as_json, damaged, damages, nonsense, replaced, reworded, swaps
from tests.support.textured_ball import camera_on_orbit, write_facescape

Written = dict[str, bytes]
POSES = [camera_on_orbit(25.0 * i, 10, 1.0, np.zeros(3)) for i in range(4)]
K = np.array([[F, 0, 50], [0, F, 40], [0, 0, 1]])


def idr(folder: Path) -> None:
    pictures(folder, [f"image/{i}.png" for i in range(4)])
    np.savez(folder / "cameras_sphere.npz", **{f"world_mat_{i}": K @ c[:3] for i, c in enumerate(CAMS)})


def facescape(folder: Path) -> None:
    write_facescape(folder, POSES, K, SIZE, pictures=False)


def colmap_of(text: bool) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        pictures(folder, [f"images/left/{i}.jpg" for i in range(4)])
        colmap(folder, "OPENCV", text)

    return write


BINARY = "colmap bin"
KINDS: dict[str, tuple[Callable[[Path], object], str]] = {
    "facescape": (facescape, "params.json"),
    "transforms": (transforms, "transforms.json"),
    "idr": (idr, "cameras_sphere.npz"),
    "metashape": (lambda f: metashape(f, 0.0), "cameras.xml"),
    "fisheye": (lambda f: transforms(f, camera_model="OPENCV_FISHEYE", k1=0.02, k4=0.001), "transforms.json"),
    "metashape k4": (lambda f: metashape(f, 0.003), "cameras.xml"),
    "realityscan": (lambda f: realityscan(f, "-0.1 0.02 -0.004 0 0.002 -0.003"), "*.xmp"),
    BINARY: (colmap_of(False), "sparse/0/*.bin"),
    "colmap txt": (colmap_of(True), "sparse/0/*.txt"),
}


class Folders(dict[str, tuple[Path, Written]]):
    """A whole capture of each kind, and the bytes of its description."""

    def __repr__(self) -> str:
        return "all kinds"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """A whole capture of each kind, and the bytes of its description."""
    found = Folders()
    for kind, (write, pattern) in KINDS.items():
        folder = tmp_path_factory.mktemp("c") / "capture"
        write(folder)
        found[kind] = folder, {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.glob(pattern))}
        scan_capture(folder)  # it is whole
    return found


def check(folder: Path, files: Written) -> None:
    for name, data in files.items():
        (folder / name).write_bytes(data)
    with bounded():
        found = find_reader(folder)
        if found is None:
            return
        for view in describe(found[0], folder, found[1]).views:
            assert view.camera is not None
            k, t = np.array(view.camera.K), np.array(view.camera.cam_from_world)[:3, 3]
            assert np.isfinite([*k.ravel(), *t, *view.camera.distortion]).all() and np.abs(t).max() <= FARTHEST
            edge = max(view.size or SIZE)
            assert FOCAL[0] * edge <= k[0, 0] <= FOCAL[1] * edge
            view.camera.model_dump_json().encode()
        if len(files) == 1:
            scan_capture(folder).artifact.canonical_json().encode()


def one(files: Written, where: float) -> tuple[str, bytes]:
    name = sorted(files)[int(where * len(files))]
    return name, files[name]


def check_damaged(folder: Path, files: Written, how: list) -> None:
    name, data = one(files, how[0][1])
    check(folder, {**files, name: damaged(data, [(k, (w * 7) % 1, v) for k, w, v in how])})


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != BINARY])
@given(how=damages)
@halved
def test_damaged_bytes(folders: Folders, kind: str, how: list) -> None:
    check_damaged(*folders[kind], how)


@given(how=damages)
@fuzzed  # no words or values are exchanged in it: all of its cases are here
def test_damaged_bytes_of_a_binary_model(folders: Folders, how: list) -> None:
    check_damaged(*folders[BINARY], how)


@pytest.mark.parametrize("kind", ["facescape", "transforms", "fisheye"])
@given(how=nonsense)
@halved
def test_nonsense_in_json(folders: Folders, kind: str, how: list) -> None:
    folder, files = folders[kind]
    name, data = one(files, 0)
    check(folder, {name: as_json(replaced(json.loads(data), how))})


@pytest.mark.parametrize("kind", ["metashape", "metashape k4", "realityscan", "colmap txt"])
@given(how=swaps)
@halved
def test_nonsense_in_text(folders: Folders, kind: str, how: list) -> None:
    folder, files = folders[kind]
    name, data = one(files, (how[0][0] * 7) % 1)
    check(folder, {**files, name: reworded(data.decode(), how).encode("utf-8", "surrogatepass")})


@given(how=nonsense)
@halved
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_nonsense_in_an_npz(folders: Folders, how: list) -> None:
    folder, files = folders["idr"]
    arrays: dict[str, object] = dict(np.load(io.BytesIO(files["cameras_sphere.npz"])))
    for where, value in how:
        name = list(arrays)[int(where * len(arrays))]
        try:
            arrays[name] = np.array(value) if isinstance(value, list | str) else arrays[name] * value  # type: ignore[operator]
        except (TypeError, ValueError, OverflowError):
            arrays[name] = np.array([value], object)
    stream = io.BytesIO()
    np.savez(stream, **arrays)  # type: ignore[arg-type]
    check(folder, {"cameras_sphere.npz": stream.getvalue()})


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    root = tmp_path_factory.mktemp("tree")
    write_tree(root, {"1/1_neutral": True})
    yield root


@given(how=nonsense)
@fuzzed
def test_nonsense_in_the_scale_dictionary(tree: Path, how: list) -> None:
    table = {"1": {"1": [0.5, np.eye(4)[:3].tolist()]}}
    (tree / "Rt_scale_dict.json").write_bytes(as_json(replaced(table, how)))
    with bounded():
        found = scan_capture(tree / "1" / "1_neutral").artifact.metres_from_world
        assert found is None or np.isfinite(found).all()


@pytest.fixture(scope="module")
def lights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """lights.json of ten calibrated lights, and its bytes."""
    folder = tmp_path_factory.mktemp("lights")
    write_lights(folder, make_stage(lights=10), encoding="linear")
    return folder / LIGHTS, (folder / LIGHTS).read_bytes()


def check_lights(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    with bounded():
        for light in read_lights(path).lights.values():
            values = np.array([*light.position, *light.axis, *light.intensity])
            assert np.isfinite(values).all() and abs(np.linalg.norm(light.axis) - 1) < 1e-6
            light.model_dump_json().encode()


@given(how=nonsense)
@halved
def test_nonsense_in_the_lights_of_a_light_stage(lights: tuple[Path, bytes], how: list) -> None:
    path, whole = lights
    check_lights(path, as_json(replaced(json.loads(whole), how)))


@given(how=damages)
@halved
def test_damaged_lights_of_a_light_stage(lights: tuple[Path, bytes], how: list) -> None:
    path, whole = lights
    check_lights(path, damaged(whole, how))
