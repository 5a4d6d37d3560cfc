"""--light: a measured light for one run, read before anything is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import StageError, UsageError
from pipeline.images import write_exr
from workflows.cli.main import main
from workflows.run.plan import check_settings, make_plan
from workflows.run.request import RunRequest


def write(folder: Path, values: np.ndarray) -> str:
    write_exr(folder / "env.exr", values.astype(np.float32))
    return str(folder / "env.exr")


def test_the_option_is_the_fits_setting(tmp_path: Path) -> None:
    path = write(tmp_path, np.ones((8, 16, 3)))
    fit = check_settings(RunRequest(capture="x", out="y", light=path))["inverse_rendering"]
    assert fit.light_file == path and len(fit.light_digest) == 64 and not fit.estimates_light  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match="outside its limits"):
        check_settings(RunRequest(capture="x", out="y", light=path, preset="paper"))


@pytest.mark.parametrize(
    ("values", "told"),
    [
        (np.ones((8, 12, 3)), "12 x 8"),
        (np.full((8, 16, 3), np.nan), "not a number"),
        (-np.ones((8, 16, 3)), "negative"),
        (np.zeros((8, 16, 3)), "black"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_written(tmp_path: Path, values: np.ndarray, told: str) -> None:
    (tmp_path / "photos").mkdir()
    out = tmp_path / "out"
    with pytest.raises(StageError, match=told):
        make_plan(RunRequest(capture=str(tmp_path / "photos"), out=str(out), light=write(tmp_path, values)))
    assert not out.exists()


def test_the_command_names_a_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    code = main(["run", str(tmp_path / "photos"), "--out", str(tmp_path / "out"), "--light", str(tmp_path / "no.exr")])
    assert code == 1 and "this light can't be read" in capsys.readouterr().err
