"""Measured expressions in the asset, beside those of the template."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdSkel
from support.synthetic_asset import SyntheticInputs, run_stage
from support.synthetic_head import template_inputs

from pipeline.artifacts import Artifact, FileRef
from pipeline.contract import Context, Stage, execute
from pipeline.errors import StageError, UsageError
from pipeline.registration.head import load_head
from pipeline.registration.shapes import save_shapes, sparse
from pipeline.store import LINEAGE, Store, lineage
from stages.usd.check.validate import validate
from stages.usd.config import Config
from tests.support.toy_stages import FirstInputs, source

OWN, SMILE = ("jawOpen", "cheekPuff"), "measured_smile"
FAST = {"render_views": False, "high": False, "obj": False, "usdz": False}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> SyntheticInputs:
    return template_inputs(tmp_path_factory.mktemp("measured"))


@pytest.fixture(scope="module")
def shapes(inputs: SyntheticInputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A smile of the front, and one that moves nothing."""
    head = load_head(inputs.template.folder / "head.npz")
    front = head.vertices[:, 2:] > 0.6 * head.vertices[:, 2].max()
    path = tmp_path_factory.mktemp("shapes") / "measured.npz"
    save_shapes(path, sparse((SMILE,), [front * np.array([0.003, 0.001, 0.0])], 1.0))
    return path


def glb_document(path: Path) -> dict[str, object]:
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    out: dict[str, object] = json.loads(data[20 : 20 + length])
    return out


def test_they_are_blend_shapes_and_morph_targets_beside_the_others(
    inputs: SyntheticInputs, shapes: Path, tmp_path: Path
) -> None:
    made = run_stage(inputs, tmp_path, measured=str(shapes), **FAST)
    assert made.warnings == ()
    stage = Usd.Stage.Open(str(tmp_path / "asset/head.usd"))
    animation = UsdSkel.Animation(next(p for p in stage.Traverse() if p.IsA(UsdSkel.Animation)))
    assert tuple(animation.GetBlendShapesAttr().Get()) == (*OWN, SMILE)
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath(f"/head/geo/render/{SMILE}"))
    offsets = np.array(shape.GetOffsetsAttr().Get())
    np.testing.assert_allclose(offsets, np.tile([0.003, 0.001, 0.0], (len(offsets), 1)), atol=1e-7)
    assert len(offsets) > 5 and not [f for f in validate(tmp_path / "asset/head.usd") if f.level == "error"]
    document = glb_document(tmp_path / "asset/head.glb")
    meshes: list[dict[str, dict[str, list[str]]]] = document["meshes"]  # type: ignore[assignment]
    assert meshes[0]["extras"]["targetNames"] == [*OWN, SMILE]


def test_the_key_has_the_file_s_content_and_not_its_path(shapes: Path, tmp_path: Path) -> None:
    copy = tmp_path / "elsewhere.npz"
    copy.write_bytes(shapes.read_bytes())
    here, there = Config(measured=str(shapes)), Config(measured=str(copy))
    assert here.model_dump() == there.model_dump() and "measured" not in here.model_dump()
    assert here.model_dump() != Config().model_dump()
    save_shapes(copy, sparse((SMILE,), [np.zeros((4, 3))], 1.0))
    assert Config(measured=str(copy)).model_dump() != here.model_dump()
    assert here.made_from() == {"measured": shapes.parent} and Config().made_from() == {}
    assert "measured_digest" not in Config.setting_names()


def test_a_missing_file_is_named_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"usd\.measured"):
        Config(measured=str(tmp_path / "none.npz"))
    with pytest.raises(UsageError, match="directory"):
        Config(measured=str(tmp_path))


def test_shapes_of_another_head_are_an_error(inputs: SyntheticInputs, tmp_path: Path) -> None:
    path = tmp_path / "other.npz"
    save_shapes(path, sparse((SMILE,), [np.full((5000, 3), 0.01)], 1.0))
    with pytest.raises(StageError, match="no measured expressions of this head"):
        run_stage(inputs, tmp_path / "out", measured=str(path), **FAST)


def test_without_expressions_they_are_left_out_with_a_note(
    inputs: SyntheticInputs, shapes: Path, tmp_path: Path
) -> None:
    made = run_stage(inputs, tmp_path, measured=str(shapes), expressions=False, **FAST)
    assert any("measured expressions were left out" in w for w in made.warnings)


class _Nothing(Artifact):
    file: FileRef


def test_what_a_setting_names_is_in_the_lineage(shapes: Path, tmp_path: Path) -> None:
    """So that purging one expression's photos finds the asset that has its shape."""

    def run(inputs: FirstInputs, config: Config, context: Context) -> _Nothing:
        (context.workdir / "x").write_text("x")
        return _Nothing(file=context.file("x"))

    photos, store = tmp_path / "photos", Store(tmp_path / "store")
    photos.mkdir()
    inside = store.root / "measured" / "k" / "m.npz"
    inside.parent.mkdir(parents=True)
    inside.write_bytes(shapes.read_bytes())
    stage = Stage("usd", 1, FirstInputs, Config, _Nothing, run)
    done = execute(stage, FirstInputs(source(photos)), Config(measured=str(inside)), store)
    known = lineage(store.root / LINEAGE / f"usd-{done.key}.json")
    assert known == {"source": [str(photos)], "measured": ["measured/k"]}
