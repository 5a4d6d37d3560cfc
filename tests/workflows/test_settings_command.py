"""`neuface settings` shows what the stages' configs say, without loading what a fit needs."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from stages.presets import PRESETS
from stages.registry import REGISTRY
from stages.settings import all_settings
from stages.together.stage import STAGE as TOGETHER
from workflows.cli.main import main


def shown(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["settings", *arguments]) == 0
    return capsys.readouterr().out


def test_the_list_has_every_setting_with_its_default_its_limits_and_what_presets_set(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = shown(capsys).splitlines()
    for stage in REGISTRY:
        assert (stage.name in lines) == bool(stage.config.setting_names())
    batch = lines.index("  batch = 4096 rays   (whole number, 16 to 1048576; film 8192; paper 2048)")
    assert lines[batch + 1].strip() == "rays in one optimisation step"
    assert "  rank = auto   (whole number, 1 to 8, or auto; paper 3)" in lines
    assert '  author = ""   (text of up to 1000 characters)' in lines
    assert not any("sha256" in line or "digest" in line for line in lines)  # filled in by the stages
    assert len(lines) == 2 * len(all_settings()) + len({(s.stage, s.only) for s in all_settings()})


def test_every_setting_says_what_it_means_and_what_it_may_be() -> None:
    for s in all_settings():
        assert len(s.meaning) > 10 and s.allowed, s.key
        assert set(s.presets) == ({"paper"} if s.only else set(PRESETS)), s.key


def test_what_is_shown_can_be_set_on_a_command_line() -> None:
    """`--set` gives text: of each default and each value of a preset it must make that value."""
    configs = {stage.name: stage.config for stage in (*REGISTRY, TOGETHER)}
    tried = 0
    for s in (s for s in all_settings() if not s.only):  # the paper's model has another config
        config = configs[s.stage]
        for value in (s.default, *s.presets.values()):
            if isinstance(value, (bool, int, float)):
                text = str(value).lower() if isinstance(value, bool) else str(value)
                assert getattr(config.model_validate({s.name: text}), s.name) == value, s.key
                tried += 1
    assert tried > 100


def test_those_of_the_papers_model_are_listed_apart(capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(capsys, "inverse_rendering").splitlines()
    title = "inverse_rendering, only with inverse_rendering.preset = paper or comparison"
    ours, papers = lines[: lines.index(title)], lines[lines.index(title) :]
    assert "  shading = neural   (neural, phong or disney)" in papers
    assert not any(line.startswith(("  shading", "  prior_file", "  method")) for line in ours)
    assert any(line.startswith("  batch = ") for line in ours) and not any(x.startswith("  batch") for x in papers)
    assert "  only with inverse_rendering.preset = paper or comparison" in shown(capsys, "inverse_rendering.shading")


def test_one_is_explained_with_its_value_in_each_preset(capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(capsys, "inverse_rendering.hash_fine")
    assert text.startswith("inverse_rendering.hash_fine: finest cell of the appearance encoding\n")
    rows = dict(line.strip().split("  ", 1) for line in text.splitlines()[1:-1])
    assert {k: v.strip() for k, v in rows.items()} == {
        "unit": "metres", "allowed": "number, more than 0, at most 0.1", "default": "0.0008", "preset draft": "0.0008",
        "preset studio": "0.0006", "preset film": "0.0003", "preset paper": "0.0008",
    }  # fmt: skip
    assert "--set inverse_rendering.hash_fine=" in text


def test_a_stage_and_a_name_that_several_stages_have(capsys: pytest.CaptureFixture[str]) -> None:
    lines = shown(capsys, "bake").splitlines()
    size = "  size = 1024 texels   (whole number, 256 to 16384; studio 2048; film 4096; paper 2048)"
    assert lines[0] == "bake" and size in lines
    assert len(lines) == 1 + 2 * len([s for s in all_settings() if s.stage == "bake"])
    assert [x for x in shown(capsys, "seed").splitlines() if x[0] != " "] == ["poses", "masks", "inverse_rendering"]
    assert shown(capsys, "report").startswith("report.viewer: ")  # a stage of one setting shows it in full


def test_json_has_a_record_for_each(capsys: pytest.CaptureFixture[str]) -> None:
    everything = json.loads(shown(capsys, "--json"))
    assert [r["key"] for r in everything] == [s.key for s in all_settings()]
    (one,) = json.loads(shown(capsys, "surface.resolution", "--json"))
    assert one == {
        "key": "surface.resolution", "stage": "surface", "name": "resolution", "unit": "grid cells", "default": 256,
        "allowed": "whole number, 16 to 1024", "meaning": one["meaning"], "only": [],
        "presets": {"draft": 512, "studio": 640, "film": 896, "paper": 640},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("maskes", ["unknown stage", "maskes", "did you mean masks?", "capture, poses"]),
        ("masks.metod", ["unknown setting of masks", "metod", "did you mean method?"]),
        ("masks.model_sha256", ["unknown setting of masks"]),
        ("report.pictures", ["unknown setting of report"]),
    ],
)
def test_an_unknown_name_is_told_as_elsewhere(word: str, told: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", word]) == 2
    error = capsys.readouterr().err
    assert all(part in error for part in told), error


def test_it_loads_nothing_that_is_heavy() -> None:
    code = (
        "import sys; from workflows.cli.main import main; main(['settings']);"
        "sys.exit(str([m for m in ('torch', 'numba', 'cv2', 'scipy', 'prefect', 'pxr') if m in sys.modules] or ''))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.strip() == "" and "hull_cells" in done.stdout
