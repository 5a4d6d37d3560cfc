"""Damaged templates: a named error, or a template that is one."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from pipeline.registration.shapes import load_shapes, save_shapes, sparse
from pipeline.template.load import load_template
from tests.support.fuzzing import bounded, fuzzed, halved
from tests.support.mutations import as_json, damaged, damages, nonsense, replaced, reworded, swaps
from tests.template.test_template_errors import as_obj, little, write


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an npz and an OBJ."""
    folder = as_obj(tmp_path_factory.mktemp("t") / "obj")
    load_template(folder)
    return folder


def check(folder: Path, files: dict[str, bytes]) -> None:
    kept = {name: (folder / name).read_bytes() for name in files}
    try:
        for name, data in files.items():
            (folder / name).write_bytes(data)
        with bounded():
            t = load_template(folder)
            assert np.isfinite(t.vertices).all() and t.quads.min() >= 0 and t.quads.max() < len(t.vertices)
            assert np.isfinite(t.landmark_points(t.vertices)).all() and np.isfinite(t.uvs).all()
            assert t.uv_quads.max() < len(t.uvs)
            t.triangles()
            for name in t.regions:
                t.region_weights(name)
    finally:
        for name, data in kept.items():
            (folder / name).write_bytes(data)


@given(how=nonsense)
@fuzzed
def test_nonsense_in_the_manifest(whole: Path, how: list[Any]) -> None:
    check(whole, {"manifest.json": as_json(replaced(json.loads((whole / "manifest.json").read_text()), how))})


@pytest.mark.parametrize("name", ["manifest.json", "head.obj"])
@given(how=damages)
@halved
def test_damaged_bytes(whole: Path, name: str, how: list[Any]) -> None:
    check(whole, {name: damaged((whole / name).read_bytes(), how)})


@given(how=swaps)
@halved
def test_nonsense_in_the_mesh(whole: Path, how: list[Any]) -> None:
    text = reworded((whole / "head.obj").read_text(), how)
    check(whole, {"head.obj": text.encode("utf-8", "surrogatepass")})


@pytest.fixture(scope="module")
def arrays_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an npz alone."""
    return write(tmp_path_factory.mktemp("a") / "npz", *little())


@given(how=damages)
@halved
def test_damaged_arrays(arrays_folder: Path, how: list[Any]) -> None:
    check(arrays_folder, {"mesh.npz": damaged((arrays_folder / "mesh.npz").read_bytes(), how)})


def nonsensical(arrays: dict[str, Any], how: list[Any]) -> bytes:
    """An npz of the arrays, some of them replaced or multiplied."""
    for where, value in how:
        name = list(arrays)[int(where * len(arrays))]
        try:
            arrays[name] = np.array(value) if isinstance(value, list | str) else arrays[name] * value
        except (TypeError, ValueError, OverflowError):
            arrays[name] = np.array([value], object)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@given(how=nonsense)
@halved
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_nonsense_in_arrays(arrays_folder: Path, how: list[Any]) -> None:
    check(arrays_folder, {"mesh.npz": nonsensical(dict(little()[1]), how)})


# ------------------------------------------------------------------ measured expressions
def shapes() -> dict[str, np.ndarray]:
    stream = io.BytesIO()
    save_shapes(stream, sparse(("measured_a", "measured_b"), [0.01 * np.ones((4, 3)), np.zeros((4, 3))], 1.0))  # type: ignore[arg-type]
    stream.seek(0)
    with np.load(stream) as z:
        return {k: z[k] for k in z.files}


def check_shapes(folder: Path, data: bytes) -> None:
    (folder / "m.npz").write_bytes(data)
    with bounded():
        e = load_shapes(folder / "m.npz")
        assert np.isfinite(e.offsets).all() and len(e.vertices) == len(e.offsets) == e.starts[-1]
        assert all(n.isidentifier() for n in e.names) and (np.diff(e.starts) >= 0).all()


@given(how=damages)
@halved
def test_damaged_measured_expressions(arrays_folder: Path, how: list[Any]) -> None:
    stream = io.BytesIO()
    np.savez(stream, **shapes())  # type: ignore[arg-type]
    check_shapes(arrays_folder, damaged(stream.getvalue(), how))


@given(how=nonsense)
@halved
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_nonsense_in_measured_expressions(arrays_folder: Path, how: list[Any]) -> None:
    check_shapes(arrays_folder, nonsensical(shapes(), how))
