"""`neuface store ls`: what takes space, by stage and by run."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.store import Store
from workflows.cli.main import main
from workflows.store.usage import usage

pytestmark = pytest.mark.usefixtures("toys")


def test_space_by_stage_and_by_run(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = photos.parent / "store"
    for name, plus in (("one", 0), ("two", 1)):
        options = ["--store", str(store), "--set", f"third.plus={plus}", "--set", "second.steps=3"]
        assert main(["run", str(photos), "--out", str(photos.parent / name), *options]) == 0
    scratch = store / "second" / f"{'a' * 64}.scratch"
    scratch.mkdir()
    (scratch / "checkpoint").write_bytes(bytes(1000))
    (store / ".locks" / f"second-{'a' * 64}").touch()
    (store / "third" / ("b" * 64)).mkdir()  # of another program: no lock, no lineage
    (store / "third" / ("b" * 64) / "big").write_bytes(bytes(10**6))
    found = usage(Store(store))
    assert [(s.stage, s.results, s.unfinished) for s in found.stages] == [
        ("second", 1, 1000), ("third", 2, 0), ("first", 1, 0)]  # fmt: skip
    assert found.stages[0].size > 300_000
    one, two = sorted(found.runs, key=lambda r: r.out)  # their sizes differ by digits of their seconds
    sizes = {s.stage: s.size for s in found.stages}
    assert one.size == sizes["first"] + sizes["second"] + one.alone and one.alone + two.alone == sizes["third"]
    assert found.unneeded == 0 and found.size == sum(sizes.values()) + 1000
    (photos.parent / "two/run.json").unlink()
    assert usage(Store(store)).unneeded == two.alone
    capsys.readouterr()
    assert main(["store", "ls", str(store)]) == 0
    text = capsys.readouterr().out
    assert text.startswith("stage ") and str(photos.parent / "one") in text and "MB in all" in text


def test_a_folder_that_is_no_store_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["store", "ls", str(tmp_path)]) == 1
    assert "there is no store" in capsys.readouterr().err
