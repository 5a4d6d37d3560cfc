"""--template: another head template for one run, read before anything is written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import StageError
from pipeline.template.load import load_template
from stages.presets import configs_for, parse_sets
from stages.template.config import folder_digest
from tests.template.test_template_errors import little, obj_text, write
from workflows.batch.request import BatchRequest
from workflows.cli.main import main
from workflows.run.plan import check_settings, make_plan
from workflows.run.request import RunRequest

DOCS = Path(__file__).parents[2] / "docs/template.md"


def test_the_asset_is_made_from_it(tmp_path: Path) -> None:
    folder = write(tmp_path / "t", *little())
    configs = configs_for("draft", {}, template=str(folder))
    assert configs["uv"].model_dump()["mesh"] == "template" and configs["template"].model_dump()["enabled"]
    assert configs["template"].model_dump()["folder_digest"] == folder_digest(folder) != ""


def test_settings_that_are_given_count_more(tmp_path: Path) -> None:
    folder = write(tmp_path / "t", *little())
    configs = configs_for("draft", parse_sets(["uv.mesh=both"]), template=str(folder))
    assert configs["uv"].model_dump()["mesh"] == "both"
    of_file = configs_for("draft", {}, {"uv": {"mesh": "scan"}}, template=str(folder))
    assert of_file["uv"].model_dump()["mesh"] == "scan" and not of_file["template"].model_dump()["enabled"]


def test_a_batch_passes_it_on(tmp_path: Path) -> None:
    batch = BatchRequest(root="tree", out=str(tmp_path), template=str(tmp_path / "t"))
    request = batch.run_request(tmp_path / "1", "1", (), {})
    assert check_settings(request)["template"].folder == str(tmp_path / "t")  # type: ignore[attr-defined]


def changed(key: str, value: Any) -> Any:
    return lambda manifest, arrays: manifest.update({key: value})


FAULTS = {
    "no manifest": (None, "no manifest"),
    "missing group": (changed("parts", {"skin": ["face", "nose"]}), "group of a template is missing"),
    "triangles": (lambda m, a: a.update(quads=a["quads"][:, :3]), "all quads"),
    "few landmarks": (lambda m, a: m.update(landmarks=m["landmarks"][:3]), "too few or too many landmarks"),
    "uvs out of range": (lambda m, a: a["uvs"].__setitem__((0, 1), 1.5), "outside their tile"),
    "leaves the folder": (changed("mesh", "../mesh.npz"), "outside its folder"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_said_before_anything_is_written(name: str, tmp_path: Path) -> None:
    change, told = FAULTS[name]
    (tmp_path / "photos").mkdir()
    folder = tmp_path / "t"
    if change is not None:
        manifest, arrays = little()
        change(manifest, arrays)
        write(folder, manifest, arrays)
    out = tmp_path / "out"
    with pytest.raises(StageError) as found:
        make_plan(RunRequest(capture=str(tmp_path / "photos"), out=str(out), template=str(folder)))
    assert told in found.value.what and str(tmp_path) in str(found.value.where) and found.value.remedy
    assert not out.exists()


def test_the_command_ends_with_the_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    code = main(["run", str(tmp_path / "photos"), "--out", str(tmp_path / "out"), "--template", str(tmp_path / "none")])
    assert code == 1 and "no manifest" in capsys.readouterr().err


def test_the_documented_conversion_makes_a_template_that_loads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of docs/template.md, with the vertices of a little OBJ."""
    text = DOCS.read_text().split("<!-- example -->")[1].split("\nVertices count")[0]
    code = "\n".join(line.removeprefix("    ") for line in text.splitlines())
    start, end = code.index("vertices = {"), code.index("mesh = read_obj")
    numbers = ", ".join(f"{n}: {v}" for n, v in zip((1, 33, 263, 133, 362, 61, 291, 0, 17, 10, 152, 168),
                                                    range(12), strict=True))  # fmt: skip
    code = f'{code[:start]}vertices = {{{numbers}}}\nskin, others = ["face", "neck"], {{}}\n{code[end:]}'
    folder = tmp_path / "studio-head"
    folder.mkdir()
    (folder / "LICENSE").write_text("ours")
    (folder / "head.obj").write_text(obj_text(little()[1]))
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "docs/template.md", "exec"), {})
    made = load_template(folder)
    assert made.name == "studio-head" and len(made.landmarks.names) == 12 and made.licence == "proprietary"
    assert np.allclose(made.landmark_points(made.vertices), made.vertices[:12])
    assert json.loads((folder / "manifest.json").read_text())["metres_per_unit"] == 0.01
