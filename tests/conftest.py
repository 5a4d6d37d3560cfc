"""Settings for all tests. The thread policy must be in the environment before any test module loads torch."""

import pipeline.threads  # noqa: F401  isort: skip

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from tests.support import spread

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "WARNING",
}
CORES = os.cpu_count() or 1
if _workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
    # Workers share the cores: with threads for all of them in each, a fit waits for the others at every operation.
    SETTINGS["OMP_NUM_THREADS"] = str(max(1, CORES // _workers))
for _name, _value in SETTINGS.items():
    os.environ.setdefault(_name, _value)
hypothesis.settings.register_profile("no_clock", deadline=None)  # a busy machine is no fault
hypothesis.settings.load_profile("no_clock")
# A shell's background jobs ignore SIGINT, nohup's SIGHUP; the programs that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Of `-n auto`."""
    return spread.workers()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if hasattr(config, "workerinput"):  # not where the tests run one after the other, in the order of their files
        spread.slow_files_first(items)


@pytest.fixture
def all_cores() -> Iterator[None]:
    """torch with a thread for each core, for tests of what threads might spoil."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(max(2, CORES))
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def repo() -> Path:
    """The repository's root."""
    return ROOT


@pytest.fixture(scope="session")
def child_environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment of a process that a test starts: the repository importable, no server of the user's, own home."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_API") and k != "NEUFACE_STORE"}
    home = tmp_path_factory.mktemp("prefect_home")
    return {
        **kept,
        "PYTHONPATH": str(ROOT),
        "PREFECT_HOME": str(home),
        "PYTHONUNBUFFERED": "1",
        "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}",
    }
