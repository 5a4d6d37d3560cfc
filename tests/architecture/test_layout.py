"""The house rules that a linter can't hold: where packages lie, what stays light, and that the registry adds up."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from pipeline.artifacts import Artifact, Located
from pipeline.contract import StageConfig
from stages import registry
from workflows.supply.lock import read_lock

HEAVY = ("torch", "pxr", "pycolmap", "prefect", "xatlas", "pymeshlab", "trimesh", "cv2", "numba", "OpenEXR", "skimage")


@pytest.mark.parametrize("name", ["pipeline", "stages", "workflows", *(f"stages.{s.name}" for s in registry.REGISTRY)])
def test_our_packages_are_ours(name: str, repo: Path) -> None:
    """The names are general: another distribution may own one."""
    file = importlib.import_module(name).__file__
    assert file is not None
    assert Path(file) == repo / Path(*name.split(".")) / "__init__.py"


def test_no_python_in_docker(repo: Path) -> None:
    """A folder `docker` with Python in it would hide the SDK of that name, which Prefect imports."""
    assert list((repo / "docker").rglob("*.py")) == []
    import docker

    assert docker.__file__ is None or not Path(docker.__file__).is_relative_to(repo / "docker")


@pytest.mark.parametrize(
    "module", ["stages", "workflows.run.plan", "workflows.cli.commands", "workflows.cli.main", "stages.presets"]
)
def test_importing_is_light(module: str, repo: Path) -> None:
    code = f"import sys, {module}; print(*sorted(m for m in {HEAVY!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=repo, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.parametrize("module", ["workflows.cli.main", "stages.__main__", "workflows.flows"])
@pytest.mark.slow
def test_entry_points_set_the_thread_policy_before_torch(module: str, repo: Path) -> None:
    code = (
        "import os, sys\n"
        "class Watch:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch': sys.exit('too late' if 'OMP_WAIT_POLICY' not in os.environ else 0)\n"
        "sys.meta_path.insert(0, Watch())\n"
        f"import {module}, torch\n"
    )
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(repo), "HOME": "/tmp"}
    done = subprocess.run([sys.executable, "-c", code], cwd=repo, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_an_optimiser_leaves_nothing_in_tmpdir(tmp_path: Path, repo: Path) -> None:
    code = "{}import torch; torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])"
    kept = {k: v for k, v in os.environ.items() if k != "TORCHINDUCTOR_CACHE_DIR"}
    environment = {**kept, "TMPDIR": str(tmp_path), "PYTHONPATH": str(repo)}
    for before, left in (("import pipeline.threads; ", 0), ("", 1)):  # the second: what torch does by itself
        subprocess.run([sys.executable, "-c", code.format(before)], env=environment, check=True)
        assert len(list(tmp_path.iterdir())) == left


def test_compiled_arithmetic_is_strict(repo: Path) -> None:
    """With fastmath a kernel rounds differently when it is compiled and when it is loaded from the cache."""
    sources = [p for top in ("pipeline", "stages", "workflows") for p in (repo / top).rglob("*.py")]
    assert any("@njit" in p.read_text() for p in sources)
    assert [str(p) for p in sources if re.search(r"fastmath\s*=", p.read_text())] == []


def test_registry_adds_up() -> None:
    names = [s.name for s in registry.REGISTRY]
    assert len(set(names)) == len(names)
    known = {registry.SOURCE}
    made: dict[str, type[Artifact]] = {}
    for stage in registry.REGISTRY:
        assert re.fullmatch(r"[a-z][a-z_]*", stage.name)
        assert stage.version >= 1
        assert issubclass(stage.config, StageConfig) and issubclass(stage.output, Artifact)
        fields = importlib.import_module(f"stages.{stage.name}.stage").Inputs.__annotations__
        assert set(stage.inputs.__dataclass_fields__) <= known, f"{stage.name} needs what no earlier stage makes"
        for field, annotation in fields.items():
            if field in made:  # the annotation names what that stage hands on
                assert str(annotation).endswith(f"[{made[field].__name__}]"), (stage.name, field, annotation)
        known.add(stage.name)
        made[stage.name] = stage.output
    assert names[0] == "capture" and names[-1] == "report"
    assert Located.__name__ == "Located"


def test_every_setting_says_what_it_is() -> None:
    every = [(s.name, config) for s in registry.REGISTRY for config in s.configs()]
    silent = [f"{stage}.{n}" for stage, config in every for n, f in config.model_fields.items() if not f.description]
    assert silent == []


def test_every_stage_has_defaults_that_survive_their_own_record() -> None:
    """What is written into a run's record gives the same settings back, and so the same key."""
    for stage in registry.REGISTRY:
        for config in stage.configs():
            plain = config()
            assert isinstance(plain, StageConfig) and config(**plain.model_dump(mode="json")) == plain, stage.name


def requirement(line: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[<>=!~\[; ]", line.strip(), maxsplit=1)[0]).lower()


def test_locks_pin_all_that_pyproject_names(repo: Path) -> None:
    project = tomllib.loads((repo / "pyproject.toml").read_text())["project"]
    named = project["dependencies"]
    tools = project["optional-dependencies"]["dev"]
    torch = {p.name for p in read_lock(repo / "requirements-torch.lock")}
    for lock, wanted in (("requirements.lock", named), ("requirements-dev.lock", named + tools)):
        pinned = {p.name for p in read_lock(repo / lock)}
        assert {requirement(w) for w in wanted} <= pinned | torch and not pinned & torch


def test_data_files_are_packaged(repo: Path) -> None:
    """Everything below our packages that is not Python is matched by a pattern of package-data."""
    import fnmatch

    data = tomllib.loads((repo / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["*"]
    for package in ("pipeline", "stages", "workflows"):
        for path in (repo / package).rglob("*"):
            if path.is_file() and path.suffix not in (".py", ".pyc") and "__pycache__" not in path.parts:
                names = (path.name, f"{path.parent.name}/{path.name}")
                assert any(fnmatch.fnmatch(n, p) for n in names for p in data), path


def test_console_script_is_installed() -> None:
    found = [e for e in importlib.metadata.entry_points(group="console_scripts") if e.name == "neuface"]
    assert [e.value for e in found] == ["workflows.cli.entry:main"]
