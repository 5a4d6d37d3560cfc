"""Settings for all tests. The thread policy must be in the environment before any test module loads torch."""

import pipeline.threads  # noqa: F401  isort: skip

import os
import signal
import sys
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]
OFFLINE = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_LOGGING_LEVEL": "WARNING",
}
for _name, _value in OFFLINE.items():
    os.environ.setdefault(_name, _value)
hypothesis.settings.register_profile("no_clock", deadline=None)  # a busy machine is no fault
hypothesis.settings.load_profile("no_clock")
# A shell's background jobs ignore SIGINT, nohup's SIGHUP; the programs that tests start would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


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
