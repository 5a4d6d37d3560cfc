"""Settings from presets, options, files and single values; and what a user is told who gets one wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.errors import UsageError
from stages import registry
from stages.presets import PRESETS, configs_for, parse_sets, read_config_file
from tests.support.toy_stages import TOYS


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_fits_the_real_stages(preset: str) -> None:
    configs = configs_for(preset, {})
    assert list(configs) == [s.name for s in registry.REGISTRY]
    assert configs["inverse_rendering"].model_dump()["preset"] == preset
    for stage, values in PRESETS[preset].items():
        dumped = configs[stage].model_dump()
        assert {k: dumped[k] for k in values} == values


def test_presets_spend_more_from_draft_to_film() -> None:
    for stage, key in (("surface", "resolution"), ("uv", "target_faces"), ("bake", "size")):
        values = [PRESETS[p][stage][key] for p in ("draft", "studio", "film")]
        assert values == sorted(values)
        assert len(set(values)) == 3


@pytest.mark.parametrize("preset", ["draft", "studio", "film"])
def test_the_mesh_is_finer_than_the_field(preset: str) -> None:
    """At equal cells marching cubes cuts off what is thinner than a cell: outlines of hair and ears moved inwards."""
    configs = configs_for(preset, {})
    grid = configs["inverse_rendering"].model_dump()["grid_cells"]
    assert configs["surface"].model_dump()["resolution"] >= 1.75 * grid


def test_shared_options_reach_the_stages_that_have_them() -> None:
    configs = configs_for("draft", {}, holdout="every:5:2", name="anna", seed=7)
    assert configs["capture"].model_dump()["holdout"] == "every:5:2"
    assert configs["usd"].model_dump()["name"] == "anna"
    assert configs["inverse_rendering"].model_dump()["seed"] == 7


def test_the_later_source_wins() -> None:
    toys = {"registry": TOYS}
    assert configs_for("draft", {}, {}, seed=1, **toys)["first"].model_dump()["seed"] == 1  # type: ignore[arg-type]
    file = {"first": {"seed": 2}}
    assert configs_for("draft", {}, file, seed=1, **toys)["first"].model_dump()["seed"] == 2  # type: ignore[arg-type]
    sets = parse_sets(["first.seed=3"])
    assert configs_for("draft", sets, file, seed=1, **toys)["first"].model_dump()["seed"] == 3  # type: ignore[arg-type]


def test_values_take_the_settings_own_type() -> None:
    sets = parse_sets(["second.steps=12", "second.pause=0.5", "second.fault=", "first.holdout=7"])
    configs = configs_for("draft", sets, registry=TOYS)
    assert configs["second"].model_dump()["steps"] == 12
    assert configs["second"].model_dump()["pause"] == 0.5
    assert configs["first"].model_dump()["holdout"] == "7"
    assert parse_sets(["a.b=[1, 2]", "a.c=null", "a.d=x=y", "a.e=[broken"]) == {
        "a": {"b": [1, 2], "c": None, "d": "x=y", "e": "[broken"}
    }


@pytest.mark.parametrize(
    ("preset", "sets", "told"),
    [
        ("studoi", [], ["unknown preset", "studoi", "draft, studio, film", "did you mean studio?"]),
        ("zzz", [], ["unknown preset", "use one of these names"]),
        ("draft", ["frist.plus=1"], ["unknown stage", "frist", "did you mean first?", "first, second, third"]),
        ("draft", ["first.puls=1"], ["unknown setting of first", "puls", "did you mean plus?", "plus, seed, holdout"]),
        ("draft", ["first.plus=1001"], ["first.plus", "1001", "less than or equal to 1000", "what is added"]),
        ("draft", ["first.plus=many"], ["first.plus", "'many'", "integer"]),
        ("draft", ["first=1"], ["stage.key=value", "first=1"]),
        ("draft", ["first.plus"], ["stage.key=value", "first.plus"]),
        ("draft", [".plus=1"], ["stage.key=value"]),
    ],
)
def test_wrong_words_are_named(preset: str, sets: list[str], told: list[str]) -> None:
    with pytest.raises(UsageError) as e:
        configs_for(preset, parse_sets(sets), registry=TOYS)
    assert e.value.exit_code == 2
    for part in told:
        assert part in str(e.value)


FIT = "inverse_rendering"


@pytest.mark.parametrize(
    ("preset", "sets", "file"),
    [
        ("paper", ["inverse_rendering.shading=phong"], {}),
        ("draft", ["inverse_rendering.preset=comparison", "inverse_rendering.shading=phong"], {}),
        ("draft", ["inverse_rendering.preset=comparison"], {FIT: {"shading": "phong"}}),
        ("draft", ["inverse_rendering.shading=phong"], {FIT: {"preset": "comparison"}}),
    ],
)
def test_the_papers_settings_need_one_of_its_presets(
    preset: str, sets: list[str], file: dict[str, dict[str, str]]
) -> None:
    """From whatever source the preset and the setting come."""
    assert configs_for(preset, parse_sets(sets), file)[FIT].model_dump()["shading"] == "phong"


@pytest.mark.parametrize(
    ("preset", "sets", "told"),
    [
        ("draft", ["inverse_rendering.shading=phong"], ["only other presets have", "preset=paper", "comparison"]),
        (
            "paper",
            ["inverse_rendering.preset=draft", "inverse_rendering.shading=phong"],
            ["only other presets have", "preset=paper"],
        ),
        ("paper", ["inverse_rendering.shadin=phong"], ["unknown setting", "did you mean shading?"]),
        ("draft", ["inverse_rendering.shadow=false"], ["unknown setting", "did you mean shadows?"]),
        ("paper", ["inverse_rendering.shading=matt"], ["inverse_rendering.shading", "'neural', 'phong' or 'disney'"]),
        ("draft", ["inverse_rendering.attenuation=phong"], ["'exponential' or 'exact'"]),
        ("draft", ["inverse_rendering.preset=papr"], ["inverse_rendering.preset", "paper and comparison"]),
    ],
)
def test_wrong_settings_of_the_paper_are_told(preset: str, sets: list[str], told: list[str]) -> None:
    with pytest.raises(UsageError) as e:
        configs_for(preset, parse_sets(sets))
    assert [part for part in told if part not in str(e.value)] == []


def test_config_files(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[first]\nplus = 3\n")
    (tmp_path / "s.json").write_text(json.dumps({"first": {"plus": 3}}))
    for name in ("s.toml", "s.json"):
        configs = configs_for("draft", {}, read_config_file(tmp_path / name), registry=TOYS)
        assert configs["first"].model_dump()["plus"] == 3


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("s.yaml", "first: 1"),
        ("s.toml", "[first\n"),
        ("s.json", "[1]"),
        ("s.json", "{"),
        ("s", ""),
        ("gone.toml", None),
    ],
)
def test_bad_config_files(tmp_path: Path, name: str, content: str | None) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(UsageError, match="settings file"):
        read_config_file(tmp_path / name)


def test_a_stage_that_is_no_table() -> None:
    with pytest.raises(UsageError, match="must be a table"):
        configs_for("draft", {}, {"first": 3}, registry=TOYS)  # type: ignore[dict-item]


def test_no_viewer_is_a_setting_of_the_report() -> None:
    from workflows.cli.main import parser
    from workflows.cli.options import with_viewer

    for flags, wanted in (([], {"report": {}}), (["--no-viewer"], {"report": {"viewer": False}})):
        options = parser().parse_args(["run", "photos", "--out", "out", *flags])
        assert with_viewer(options, {"report": {}}) == wanted
