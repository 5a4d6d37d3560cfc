"""What the first moments of a command load. Counted in modules, because times depend on the machine."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

LIBRARIES = ("torch", "numba", "cv2", "scipy", "PIL", "pxr", "prefect", "matplotlib", "trimesh", "pycolmap")
FRAMEWORKS = ("numpy", "pydantic", "stages", "workflows.cli.commands")
CODE = """
import sys
from workflows.cli.entry import main
try:
    code = main({arguments})
except SystemExit as e:
    code = e.code
print("loaded:", *(m for m in {modules} if m in sys.modules), file=sys.stderr)
sys.exit(code)
"""


def loaded(arguments: list[str], modules: tuple[str, ...]) -> tuple[list[str], str]:
    """Those of `modules` that a process of its own has after the command, and the command's output."""
    code = CODE.format(arguments=arguments, modules=modules)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("loaded:"), done.stderr
    return last.split()[1:], done.stdout


def test_help_loads_the_command_line_alone() -> None:
    found, text = loaded(["--help"], (*LIBRARIES, *FRAMEWORKS))
    assert found == []
    assert "turntable" in text and "batch" in text


def test_the_plan_of_a_run_loads_no_library(tmp_path: Path) -> None:
    """Up to the first stage: settings, the capture's format, keys, the device (torch is a build for the CPU here)."""
    from importlib.metadata import version

    if not version("torch").endswith("+cpu"):
        pytest.skip("a torch that may have a GPU is asked for it")
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        (photos / f"{i}.jpg").write_bytes(b"no picture, and not opened by the plan")
    found, text = loaded(["run", str(photos), "--out", str(tmp_path / "out"), "--dry-run"], LIBRARIES)
    assert found == []
    assert "inverse_rendering" in text


@pytest.mark.parametrize("torch", ["2.13.0+cpu", "2.13.0", "2.13.0+cu128", None])
def test_auto_asks_torch_unless_it_is_a_build_for_the_cpu(torch: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    from importlib.metadata import PackageNotFoundError

    from workflows.run import plan

    class Cuda:
        is_available = staticmethod(lambda: True)

    def version(name: str) -> str:
        if torch is None:
            raise PackageNotFoundError(name)
        return torch

    monkeypatch.setattr(plan, "version", version)
    monkeypatch.setitem(sys.modules, "torch", type("Torch", (), {"cuda": Cuda, "__version__": torch}))
    monkeypatch.setattr(plan, "_has_kernels", lambda: False)
    assert plan.device_for("auto") == "cpu"  # the processor is faster than a GPU in plain torch
    monkeypatch.setattr(plan, "_has_kernels", lambda: True)
    assert plan.device_for("auto") == ("cpu" if torch == "2.13.0+cpu" else "cuda")
    assert plan.device_for("cuda") == "cuda"
    assert plan.device_for("cpu") == "cpu"


def test_a_gpu_has_a_batch_of_its_own_unless_one_is_given() -> None:
    """Whoever runs on a GPU gets the accuracy that it gives for nothing; the paper's systems keep the paper's batch."""

    from stages.inverse_rendering.config import GPU_BATCH
    from workflows.run.plan import check_settings, of_gpu
    from workflows.run.request import RunRequest

    def batch(**changes: Any) -> Any:
        asked = RunRequest(capture="photos", out="out", **changes)
        return of_gpu(asked, check_settings(asked))["inverse_rendering"].model_dump()["batch"]

    assert batch() == batch(preset="film") == GPU_BATCH
    assert batch(sets=("inverse_rendering.batch=512",)) == 512
    assert batch(sets=("inverse_rendering.batch=32768",)) == 32768
    assert batch(config={"inverse_rendering": {"batch": 1024}}) == 1024
    assert batch(sets=("inverse_rendering.preset=paper",)) == 2048
