"""What a user reads when something is wrong."""

from __future__ import annotations

import errno
import pickle

import pytest

from pipeline.errors import Cancelled, StageError, UsageError, stage_error_from_os_error


def test_a_failure_names_all_five_things() -> None:
    text = str(StageError("too few photos", where="capture", value=2, limit="at least 3", remedy="add photos"))
    for part in ("too few photos", "capture", "2", "at least 3", "add photos"):
        assert part in text


def test_exit_codes() -> None:
    assert StageError("", where="", value="", limit="", remedy="").exit_code == 1
    assert UsageError("", where="", value="", limit="", remedy="").exit_code == 2
    assert Cancelled("").exit_code == 130


@pytest.mark.parametrize("kind", [StageError, UsageError])
def test_errors_cross_processes(kind: type[StageError]) -> None:
    """Prefect and multiprocessing pickle exceptions; one that can't be rebuilt hides the reason of a failure."""
    error = kind("what", where="there", value=[1, 2], limit=3.5, remedy="mend")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is kind
    assert str(back) == str(error)
    assert back.remedy == "mend"


@pytest.mark.parametrize(
    ("number", "told"),
    [(errno.ENOSPC, "no space"), (errno.EDQUOT, "quota"), (errno.EROFS, "read-only"), (errno.EACCES, "permission"),
     (errno.EPERM, "permission"), (errno.ENOTDIR, "file is where a folder")],
)  # fmt: skip
def test_disk_faults_have_their_own_words(number: int, told: str) -> None:
    found = stage_error_from_os_error(OSError(number, "as the system says", "/some/file"), "/fallback")
    assert found is not None
    assert told in str(found)
    assert "/some/file" in str(found)


def test_other_os_errors_are_left_alone() -> None:
    assert stage_error_from_os_error(OSError(errno.EINVAL, "bug"), "/x") is None
    assert stage_error_from_os_error(OSError("no number"), "/x") is None
    nameless = stage_error_from_os_error(OSError(errno.ENOSPC, "full"), "/fallback")
    assert nameless is not None and "/fallback" in str(nameless)
