"""`neuface render --light`: lamps from the command line, the published field, and pictures of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.errors import StageError, UsageError
from pipeline.images import read_exr, write_exr
from pipeline.transforms import rows
from stages.reflectance.deform import write_rest
from stages.reflectance.field import save
from tests.reflectance.test_field import field_of
from tests.support.light_stage import SIZE, make_stage, write_stage
from workflows.cli.main import main
from workflows.cli.parsing import joined
from workflows.cli.relight import environment, lamp_from
from workflows.cli.render import capture_from_asset_of
from workflows.run.publish import reflectance_files


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder with the field of a matt ball, and a capture with cameras beside it."""
    save(field_of(np.array([0.5, 0.4, 0.3])), tmp_path / "run" / "reflectance", {})
    (tmp_path / "run" / "run.json").write_text(json.dumps({"capture_from_asset": rows(np.eye(4))}))
    write_stage(tmp_path / "in", make_stage(2, 8))
    return tmp_path / "run"


def test_pictures_are_written_and_lights_add_up(run: Path) -> None:
    common = [str(run), "--cameras", str(run.parent / "in" / "params.json"), "--views", "1"]
    first, second = ["--light", "0.3,0.4,1.2,4,4,4"], ["--light", "1.2,0.4,0.3,1,2,3"]
    made = {}
    for name, lights in (("a", first), ("b", second), ("both", [*first, *second])):
        assert main(["render", *common, *lights, "--out", str(run.parent / name)]) == 0
        made[name] = read_exr(run.parent / name / "1.exr")[0]
        assert (run.parent / name / "1.png").is_file()
    assert made["a"].shape == (SIZE, SIZE, 4) and made["a"][..., 0].max() > 0.2
    np.testing.assert_allclose(made["both"][..., :3], made["a"][..., :3] + made["b"][..., :3], atol=1e-5)


def test_a_lamp_to_the_left_needs_no_equals_sign(run: Path) -> None:
    """Its place begins with a minus, as options do."""
    common = ["render", str(run), "--cameras", str(run.parent / "in" / "params.json"), "--views", "1"]
    for name, light in (("a", ["--light", "-0.3,0.4,1.2"]), ("b", ["--light=-0.3,0.4,1.2"])):
        assert main([*common, *light, "--light", "-.2,0,1", "--out", str(run.parent / name)]) == 0
    assert (run.parent / "a/1.exr").read_bytes() == (run.parent / "b/1.exr").read_bytes()


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("render x --light -0.3,0,1 --quick", ["render", "x", "--light=-0.3,0,1", "--quick"]),
        ("--light -.3 --light 1", ["--light=-.3", "--light", "1"]),
        ("--light --quick", ["--light", "--quick"]),
        ("--light -q", ["--light", "-q"]),
        ("--env -1", ["--env", "-1"]),
        ("-- --light -1", ["--", "--light", "-1"]),
        ("--light", ["--light"]),
        ("-1", ["-1"]),
    ],
)
def test_a_value_with_a_minus_is_joined_with_its_option(words: str, wanted: list[str]) -> None:
    assert joined(words.split()) == wanted == joined(wanted)


def test_an_environment_is_a_light_too(run: Path) -> None:
    env = run.parent / "white.exr"
    write_exr(env, np.ones((16, 32, 3), np.float32))
    common = [str(run), "--cameras", str(run.parent / "in" / "params.json"), "--views", "0", "--env", str(env)]
    assert main(["render", *common, "--field", "--quick", "--out", str(run.parent / "lit")]) == 0
    shown = read_exr(run.parent / "lit" / "0.exr")[0][SIZE // 2, SIZE // 2]
    np.testing.assert_allclose(shown[:3], [0.5, 0.4, 0.3], rtol=0.06)


def test_a_light_is_given_in_the_captures_world() -> None:
    """Oracle: the same irradiance at the ball's centre in both worlds."""
    field, half = field_of(np.full(3, 0.5)), np.diag([0.5, 0.5, 0.5, 1.0])
    lamp = lamp_from("0,0,0.65,2,2,2", half, field)
    np.testing.assert_allclose(lamp.position, [0, 0, 1.3])
    np.testing.assert_allclose(lamp.axis, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(lamp.strength / 1.3**2, 2 / 0.65**2)
    turned = environment("key", np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]), quick=True)
    plain = environment("key", np.eye(4), quick=True)
    np.testing.assert_allclose(turned[0].axis, plain[0].axis[[2, 1, 0]] * [-1, 1, 1], atol=1e-6)


@pytest.mark.parametrize("text", ["1,2", "a,b,c", "0,0,nan", "0,0,1,-1,0,0", "0,0,0.01", "1,2,3,4"])
def test_bad_lights_are_named(text: str) -> None:
    with pytest.raises(UsageError, match="a light"):
        lamp_from(text, np.eye(4), field_of(np.full(3, 0.5)))


def test_a_deformed_mesh_is_lit_where_it_is(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: a ball that was moved to the side is seen there, as bright under a lamp that moved with it."""
    field = field_of(np.array([0.5, 0.4, 0.3]))
    mesh = run.parent / "moved.obj"
    shift = np.array([0.04, 0, 0])
    write_rest(mesh, replace(field.mesh, vertices=field.mesh.vertices + shift.astype(np.float32)), field.charts)
    common = ["render", str(run), "--cameras", str(run.parent / "in" / "params.json"), "--views", "0"]
    assert main([*common, "--light", "0,0,1.3,4,4,4", "--out", str(run.parent / "a")]) == 0
    assert main([*common, "--light", "0,0,1.3,4,4,4", "--deform", str(mesh), "--out", str(run.parent / "b")]) == 0
    a, b = (read_exr(run.parent / name / "0.exr")[0] for name in ("a", "b"))
    middle = [float((x[..., 3].sum(0) @ np.arange(SIZE)) / x[..., 3].sum()) for x in (a, b)]
    assert abs(middle[1] - middle[0]) > 8 and a[..., :3].max() == pytest.approx(b[..., :3].max(), rel=0.1)
    assert main([*common, "--light", "0,0,1.3", "--deform", "no.obj", "--out", str(run.parent / "c")]) == 1
    assert "deformed mesh can't be read" in capsys.readouterr().err and not (run.parent / "c").exists()


def test_bad_requests_are_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["render", str(run), "--out", str(run.parent / "x"), "--cameras", str(run.parent / "in" / "params.json")]
    assert main([*common, "--field"]) == 2 and "needs a light" in capsys.readouterr().err
    assert main([*common, "--light", "0,0,2", "--turntable", "3"]) == 2
    (run / "reflectance" / "basis.json").write_text("{")
    assert main([*common, "--light", "0,0,2"]) == 1 and "can't be read" in capsys.readouterr().err
    (run / "run.json").unlink()
    with pytest.raises(StageError, match="not known"):
        capture_from_asset_of(run)


def test_the_field_is_published_beside_the_asset(tmp_path: Path) -> None:
    files = [SimpleNamespace(path=f"reflectance/{n}") for n in ("basis.json", "albedo.exr")]
    located = SimpleNamespace(artifact=SimpleNamespace(files=files), path=lambda f: tmp_path / f.path)
    done = {"reflectance": SimpleNamespace(located=located)}
    assert reflectance_files(done) == {n: tmp_path / "reflectance" / n for n in ("basis.json", "albedo.exr")}
    assert reflectance_files({}) == {}
