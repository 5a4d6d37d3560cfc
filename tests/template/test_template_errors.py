"""What is wrong with somebody's template is named; a whole one of another topology loads."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import StageError
from pipeline.template import files
from pipeline.template.load import load_template

SIDE = 5  # vertices along each side of the little template
Change = Callable[[dict[str, Any], dict[str, Any]], None]


def little() -> tuple[dict[str, Any], dict[str, Any]]:
    """Manifest and arrays of a curved square of 4 x 4 quads: the left half is `face`, the other `neck`."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(-1, 1, SIDE))
    vertices = np.stack([x, y, 0.3 * x * x], -1).reshape(-1, 3)
    i = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    quads = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]], -1).reshape(-1, 4)
    landmarks = [
        {"name": f"p{k}", "network": k, "corners": quads[k, :3].tolist(), "weights": [0.5, 0.25, 0.25]}
        for k in range(12)
    ]
    basis = np.zeros((2, len(vertices), 3))
    basis[0, :, 1] = basis[1, :, 2] = len(vertices) ** -0.5
    arrays = {
        "vertices": vertices, "quads": quads, "uvs": (vertices[:, :2] + 1) / 2, "uv_quads": quads,
        "group": np.arange(len(quads)) % 2, "mirror": i[:, ::-1].ravel(), "joints": np.zeros((1, 3)),
        "identity_basis": basis, "identity_deviation": np.array([0.2, 0.1]),
        "identity_symmetric": np.array([True, True]),
        "identity_joints": np.ones((2, 1, 3)), "expression_starts": np.array([0, 2]),
        "expression_vertices": np.array([3, 4]), "expression_offsets": np.ones((2, 3)),
    }  # fmt: skip
    manifest = {
        "format": "neuface-template", "version": 1, "name": "little", "licence": "CC0-1.0", "licence_file": "LICENSE",
        "mesh": "mesh.npz", "metres_per_unit": 0.1, "groups": ["face", "neck"], "parts": {"skin": ["face", "neck"]},
        "regions": {"face": ["face"], "neck": ["neck"]}, "joints": ["head"], "expressions": ["jawOpen"],
        "landmarks": landmarks,
    }  # fmt: skip
    return manifest, arrays


def write(folder: Path, manifest: dict[str, Any], arrays: dict[str, Any]) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "LICENSE").write_text("free")
    (folder / "manifest.json").write_text(json.dumps(manifest))
    np.savez(folder / "mesh.npz", **arrays)
    return folder


def refused(folder: Path) -> StageError:
    with pytest.raises(StageError) as caught:
        load_template(folder)
    error = caught.value
    assert error.what and str(error.where) and str(error.limit) and error.remedy
    return error


def test_a_whole_one_loads(tmp_path: Path) -> None:
    t = load_template(write(tmp_path / "t", *little()))
    assert t.vertices[:, 0].max() == pytest.approx(0.1) and len(t.parts["skin"]) == 16 and len(t.regions["face"]) == 8
    assert t.identity([1.0])[0] - t.vertices[0] == pytest.approx([0, 0.02 * 25**-0.5, 0])
    assert t.joints_of([1.0, 1.0])["head"] == pytest.approx([0.03] * 3)
    assert np.flatnonzero(t.expression("jawOpen")[:, 0]).tolist() == [3, 4] and t.expression("jawOpen").max() == 0.1
    assert t.landmark_points(t.vertices).shape == (12, 3) and t.licence_text == "free"


def test_identity_and_expressions_may_be_left_out(tmp_path: Path) -> None:
    manifest, arrays = little()
    kept = {k: v for k, v in arrays.items() if not k.startswith(("identity", "expression", "joints", "mirror"))}
    for key in ("joints", "expressions"):
        del manifest[key]
    t = load_template(write(tmp_path / "t", manifest, kept))
    assert t.shape is None and t.expressions is None and t.joints == {}
    assert np.array_equal(t.identity([3.0]), t.vertices) and np.array_equal(t.mirror, arrays["mirror"]), "found"
    with pytest.raises(StageError, match="no such expression"):
        t.expression("jawOpen")


def obj_text(arrays: dict[str, Any]) -> str:
    lines = [f"v {x} {y} {z}" for x, y, z in arrays["vertices"]] + [f"vt {u} {v}" for u, v in arrays["uvs"]]
    for k, name in enumerate(("face", "neck")):
        lines.append(f"g {name}")
        for quad in arrays["quads"][arrays["group"] == k]:
            lines.append("f " + " ".join(f"{v + 1}/{v + 1}" for v in quad))
    return "\n".join(lines)


def as_obj(folder: Path, change: Callable[[str], str] = lambda text: text) -> Path:
    manifest, arrays = little()
    manifest |= {"mesh": "head.obj"}
    for key in ("groups", "joints", "expressions"):
        del manifest[key]
    write(folder, manifest, arrays)
    (folder / "head.obj").write_text(change(obj_text(arrays)))
    return folder


def test_an_obj_loads(tmp_path: Path) -> None:
    t = load_template(as_obj(tmp_path / "t"))
    _, arrays = little()
    assert np.allclose(t.vertices, arrays["vertices"] * 0.1) and len(t.regions["neck"]) == 8
    assert {tuple(q) for q in t.quads} == {tuple(q) for q in arrays["quads"]} and np.array_equal(t.uv_quads, t.quads)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda t: t.replace("f 1/1 2/2 7/7 6/6", "f 1/1 2/2 7/7"), "all quads"),
        (lambda t: t.replace("f 1/1", "f 1"), "can't be read"),
        (lambda t: t.replace("v -1.0", "v x", 1), "can't be read"),
        (lambda t: t.replace("v -1.0", "v nan", 1), "array of a template is wrong"),
        (lambda t: t.replace("v -1.0 -1.0 0.3", "v -1.0 -1.0", 1), "too few numbers"),
        (lambda t: t.replace("g neck", "g throat"), "group of a template is missing"),
        (lambda t: t.replace("f 1/1 ", "f 99/1 "), "array of a template is wrong"),
        (lambda t: t.replace("f 1/1 ", "f 1/-99 "), "array of a template is wrong"),
        (lambda t: t.replace("v 1.0 1.0", "v 1.5 1.0"), "not symmetric"),
        (lambda t: "", "array of a template is wrong"),
    ],
)
def test_bad_obj_files(tmp_path: Path, change: Callable[[str], str], what: str) -> None:
    assert change(obj_text(little()[1])) != obj_text(little()[1])
    assert what in refused(as_obj(tmp_path / "t", change)).what


def put(key: str, value: Any) -> Change:
    return lambda manifest, arrays: manifest.update({key: value})


def drop(key: str) -> Change:
    return lambda manifest, arrays: manifest.pop(key)


def poke(key: str, index: Any, value: Any) -> Change:
    return lambda manifest, arrays: arrays[key].__setitem__(index, value)


def swap(key: str, change: Callable[[Any], Any]) -> Change:
    return lambda manifest, arrays: arrays.update({key: change(arrays[key])})


def landmark(key: str, value: Any) -> Change:
    return lambda manifest, arrays: manifest["landmarks"][3].update({key: value})


BAD: dict[str, tuple[Change, str]] = {
    "another format": (put("format", "obj"), "another format"),
    "another version": (put("version", 2), "another format"),
    "no parts": (drop("parts"), "key of a template's manifest is missing"),
    "no licence": (drop("licence_file"), "key of a template's manifest is missing"),
    "no licence file": (put("licence_file", "none.txt"), "file is missing"),
    "no skin": (put("parts", {"body": ["face", "neck"]}), "no skin"),
    "missing group": (put("parts", {"skin": ["face", "nose"]}), "group of a template is missing"),
    "group in no region": (put("regions", {"face": ["face"]}), "in none of its regions"),
    "group twice": (put("regions", {"face": ["face"], "neck": ["neck", "face"]}), "in two regions"),
    "parts a list": (put("parts", ["skin"]), "value of a template's manifest is wrong"),
    "groups twice": (put("groups", ["face", "face"]), "value of a template's manifest is wrong"),
    "too few groups": (put("groups", ["face"]), "array of a template is wrong"),
    "unit zero": (put("metres_per_unit", 0), "value of a template's manifest is wrong"),
    "unit text": (put("metres_per_unit", "cm"), "value of a template's manifest is wrong"),
    "name with a line": (put("name", "a\nb"), "value of a template's manifest is wrong"),
    "no landmarks": (put("landmarks", []), "too few or too many landmarks"),
    "few landmarks": (lambda m, a: m.update(landmarks=m["landmarks"][:11]), "too few or too many landmarks"),
    "many landmarks": (lambda m, a: m.update(landmarks=m["landmarks"] * 40), "too few or too many landmarks"),
    "same landmark": (landmark("network", 4), "same network number"),
    "same name": (landmark("name", "p4"), "same name"),
    "landmark number": (landmark("network", 468), "value of a template's manifest is wrong"),
    "landmark corners": (landmark("corners", [1, 2]), "value of a template's manifest is wrong"),
    "landmark weights": (landmark("weights", [0.5, 0.5, 0.5]), "value of a template's manifest is wrong"),
    "landmark weights text": (landmark("weights", ["a", 0, 1]), "value of a template's manifest is wrong"),
    "landmark far": (landmark("corners", [1, 2, 99]), "array of a template is wrong"),
    "landmark off": (put("parts", {"skin": ["face"], "rest": ["neck"]}), "not on its skin"),
    "triangles": (swap("quads", lambda q: q[:, :3]), "all quads"),
    "quads out of range": (poke("quads", (0, 0), 25), "array of a template is wrong"),
    "quads negative": (poke("quads", (0, 0), -1), "array of a template is wrong"),
    "quad with a point": (poke("quads", (0, 0), 1), "array of a template is wrong"),
    "loose vertex": (swap("vertices", lambda v: np.vstack([v, v[:1]])), "array of a template is wrong"),
    "NaN": (poke("vertices", (2, 1), np.nan), "array of a template is wrong"),
    "huge": (poke("vertices", (2, 1), 1e300), "array of a template is wrong"),
    "floats as quads": (swap("quads", lambda q: q * 1.0), "array of a template is wrong"),
    "no uvs": (lambda m, a: a.pop("uvs"), "array of a template is wrong"),
    "uvs infinite": (poke("uvs", (0, 0), np.inf), "array of a template is wrong"),
    "uvs above": (poke("uvs", (0, 1), 1.2), "outside their tile"),
    "uvs across tiles": (swap("uvs", lambda u: u + [0.1, 0]), "outside their tile"),
    "uvs before the first tile": (swap("uvs", lambda u: u - [1, 0]), "outside their tile"),
    "uvs on the ninth tile": (swap("uvs", lambda u: u + [8, 0]), "outside their tile"),
    "uvs not on the first tile": (swap("uvs", lambda u: u + [1, 0]), "tile of its row empty"),
    "uvs out of range": (poke("uv_quads", (0, 0), 30), "array of a template is wrong"),
    "mirror no pairs": (poke("mirror", 0, 3), "array of a template is wrong"),
    "mirror out of range": (poke("mirror", 0, 70), "array of a template is wrong"),
    "group out of range": (poke("group", 0, 2), "array of a template is wrong"),
    "basis not orthonormal": (swap("identity_basis", lambda b: 2 * b), "array of a template is wrong"),
    "basis of others": (swap("identity_basis", lambda b: b[:, :9]), "array of a template is wrong"),
    "basis NaN": (poke("identity_basis", (0, 0, 0), np.nan), "array of a template is wrong"),
    "deviations rising": (swap("identity_deviation", lambda d: d[::-1]), "array of a template is wrong"),
    "deviations few": (swap("identity_deviation", lambda d: d[:1]), "array of a template is wrong"),
    "joints few": (put("joints", ["head", "neck"]), "array of a template is wrong"),
    "expressions many": (put("expressions", ["jawOpen", "b"]), "array of a template is wrong"),
    "expression starts": (poke("expression_starts", 1, 9), "array of a template is wrong"),
    "expression vertex": (poke("expression_vertices", 1, 25), "array of a template is wrong"),
    "objects": (swap("uvs", lambda u: np.array([{}], object)), "arrays can't be read"),
    "leaves the folder": (put("mesh", "../mesh.npz"), "outside its folder"),
    "absolute": (put("mesh", "/etc/passwd"), "outside its folder"),
    "backslashes": (put("licence_file", "..\\x"), "outside its folder"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_templates_are_named(tmp_path: Path, name: str) -> None:
    change, what = BAD[name]
    manifest, arrays = little()
    change(manifest, arrays)
    assert what in refused(write(tmp_path / "t", manifest, arrays)).what


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"a": NaN}', "[" * 100_000, "\ud800".encode("utf-8", "surrogatepass")]
)
def test_broken_json(tmp_path: Path, text: str | bytes) -> None:
    folder = write(tmp_path / "t", *little())
    (folder / "manifest.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert refused(folder).what.startswith("a template's")


def test_no_folder_and_no_manifest(tmp_path: Path) -> None:
    assert "no manifest" in refused(tmp_path / "nothing").what
    assert "no manifest" in refused(tmp_path).what


def test_links_are_refused(tmp_path: Path) -> None:
    folder = write(tmp_path / "t", *little())
    (folder / "mesh.npz").rename(tmp_path / "real.npz")
    (folder / "mesh.npz").symlink_to(tmp_path / "real.npz")
    assert "symbolic link" in refused(folder).what
    (folder / "mesh.npz").unlink()
    (folder / "manifest.json").rename(tmp_path / "real.json")
    (folder / "manifest.json").symlink_to(tmp_path / "real.json")
    assert refused(folder).value == "a link"


def test_a_link_on_the_way_is_refused(tmp_path: Path) -> None:
    manifest, arrays = little()
    folder = write(tmp_path / "t", manifest | {"mesh": "sub/mesh.npz"}, arrays)
    write(tmp_path / "other", manifest, arrays)
    (folder / "sub").symlink_to(tmp_path / "other")
    assert "symbolic link" in refused(folder).what


def test_too_large_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write(tmp_path / "t", *little())
    monkeypatch.setattr(files, "MAX_UNPACKED", 1000)
    assert "too large" in refused(folder).what
    monkeypatch.setattr(files, "MAX_FILE", 100)
    assert "too large" in refused(folder).what
    monkeypatch.setattr(files, "MAX_TEXT", 100)
    assert "too large" in refused(folder).what


def test_damaged_arrays(tmp_path: Path) -> None:
    folder = write(tmp_path / "t", *little())
    whole = (folder / "mesh.npz").read_bytes()
    for damaged in (b"", b"PK", whole[: len(whole) // 2], whole[:200] + b"\xff" * 40 + whole[240:]):
        (folder / "mesh.npz").write_bytes(damaged)
        assert "can't be read" in refused(folder).what
    with zipfile.ZipFile(folder / "mesh.npz", "w") as archive:
        archive.writestr("quads.txt", "1 2 3")
    assert refused(folder).what.startswith("a")
