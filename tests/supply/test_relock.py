"""The last step of `make lock`, with a pip that answers from a table."""

from __future__ import annotations

from pathlib import Path

import pytest

from workflows.supply import relock
from workflows.supply.lock import Pinned, read_lock

A, B, C = "a" * 64, "b" * 64, "c" * 64
COMPILED = (
    f"# old head\nsympy==1 \\\n    --hash=sha256:{A}\n    # via torch\n"
    f"torch==2.13.0+cpu \\\n    --hash=sha256:{B}\n    # via x\ntorchvision-like==3 --hash=sha256:{C}\n"
)


def test_torch_is_taken_out_and_no_other() -> None:
    text, version = relock.without_torch(COMPILED)
    assert version == "2.13.0" and text == COMPILED.replace("# old head\n", "").replace(
        f"torch==2.13.0+cpu \\\n    --hash=sha256:{B}\n    # via x\n", ""
    )
    assert relock.without_torch("a==1\n") == ("a==1\n", "")


def test_the_locks_of_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hashes of this machine's source, of PyPI, and of the lock of before if it has the same version."""
    for name in relock.MADE:
        (tmp_path / name).write_text(COMPILED)
    asked: list[tuple[str, ...]] = []

    def answer(version: str, options: tuple[str, ...], environment: dict[str, str]) -> str | None:
        asked.append(options)
        assert version == "2.13.0" and bool(environment) == bool(options)
        return None if "3.12" in options else B if options else A

    monkeypatch.setattr(relock, "hash_of", answer)
    for before, hashes in (
        (f"torch==2.13.0 --hash=sha256:{C}\n", (A, B, C)),
        (f"torch==2 --hash=sha256:{C}\n", (A, B)),
    ):
        for name in relock.MADE:
            (tmp_path / name).write_text(COMPILED)
        (tmp_path / "requirements-torch.lock").write_text(before)
        assert relock.main(tmp_path) == 0
        assert read_lock(tmp_path / "requirements-torch.lock") == [Pinned("torch", "2.13.0", hashes)]
        assert [p.name for p in read_lock(tmp_path / "requirements.lock")] == ["sympy", "torchvision-like"]
    assert len(asked) == 10


def test_locks_that_disagree_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "requirements.lock").write_text(COMPILED)
    (tmp_path / "requirements-dev.lock").write_text(COMPILED.replace("2.13.0", "2.14.0"))
    assert relock.main(tmp_path) == 1
    assert "2.13.0" in capsys.readouterr().err
