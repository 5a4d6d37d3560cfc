"""How the tests are spread over processes (tests/support/spread.py)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support import spread


def test_what_is_shared_is_made_once_and_not_by_a_maker_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two workers of one run: their own folders lie in the run's."""

    class Worker:
        def __init__(self, name: str) -> None:
            self.own = tmp_path / name
            self.own.mkdir()

        def getbasetemp(self) -> Path:
            return self.own

    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw0")
    made: list[Path] = []

    def failing(folder: Path) -> None:
        (folder / "half").touch()
        raise ValueError

    def make(folder: Path) -> list[str]:
        assert not list(folder.iterdir())
        (folder / "file").touch()
        made.append(folder)
        return ["result"]

    first, second = Worker("gw0"), Worker("gw1")
    with pytest.raises(ValueError):
        spread.made_once(first, "thing", failing)  # type: ignore[arg-type]
    found = [spread.made_once(w, "thing", make) for w in (first, second, first)]  # type: ignore[arg-type]
    assert found == [["result"]] * 3 and found[0] is not found[2]
    assert len(made) == 1 and (made[0] / "file").exists() and made[0].is_relative_to(tmp_path / "shared_thing")


@pytest.mark.parametrize(
    ("cores", "gigabytes", "expected"), [(1, 64, 0), (2, 8, 2), (2, 3, 0), (3, 64, 3), (16, 64, 4), (16, 5, 2)]
)
def test_no_more_workers_than_the_machine_has_room_for(
    cores: int, gigabytes: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)), raising=False)
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": gigabytes * 2**18}.__getitem__)
    assert spread.workers() == expected
