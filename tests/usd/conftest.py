"""One exported asset, shared by the tests that only look at it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.spread import made_once  # noqa: E402
from support.synthetic_asset import SyntheticInputs, write_inputs  # noqa: E402

from pipeline.contract import Context  # noqa: E402


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> SyntheticInputs:
    return made_once(tmp_path_factory, "usd_inputs", write_inputs)


@pytest.fixture(scope="session")
def exported(inputs: SyntheticInputs, tmp_path_factory: pytest.TempPathFactory):
    """(folder, UsdAsset) of one run of the stage."""
    from stages.usd.stage import STAGE, Config, Inputs

    def export(folder: Path):
        context = Context(folder / "work", folder / "scratch")
        named = {n: getattr(inputs, n) for n in Inputs.__slots__}
        asset = STAGE.run(Inputs(**named), Config(preview_size=64, environment_width=128), context)
        return folder / "work", asset

    return made_once(tmp_path_factory, "usd_exported", export)
