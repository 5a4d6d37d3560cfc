"""Videos of several people in one folder: what was made from one of them goes without the others'."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipeline.contract import Stage
from pipeline.store import LINEAGE, Store, lineage
from stages import registry
from tests.support.toy_stages import SECOND, THIRD, Config, FirstInputs, Number, _write
from workflows.batch.state import BatchState, Entry
from workflows.cli.main import main
from workflows.run.plan import make_plan
from workflows.run.publish import publish
from workflows.run.request import RunRequest
from workflows.run.runner import run_stages
from workflows.store.gc import belongings, purge


class Film(Number):
    """As the real first stage's manifest, it says what the capture was."""

    kind: str = "video"


def run_film(inputs: Any, config: Config, context: Any) -> Film:
    size = inputs.source.artifact.photos[0].size
    return Film(**_write(context, size).model_dump())


@pytest.fixture
def films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with three videos, and toy stages that take what is read of the real folder."""
    first: Stage[Any, Any, Any] = Stage("first", 1, FirstInputs, Config, Film, run_film)
    monkeypatch.setattr(registry, "REGISTRY", (first, SECOND, THIRD))
    folder = tmp_path / "films"
    folder.mkdir()
    for size, name in enumerate(("anna.mp4", "ben.mp4", "cleo.mov"), 1):
        (folder / name).write_bytes(b"x" * size)
    return folder


def run(capture: Path, out: Path, store: Path, *, published: bool = True) -> set[Path]:
    """Returns the folders in the store."""
    plan = make_plan(RunRequest(capture=str(capture), out=str(out), store=str(store)))
    out.mkdir(parents=True)
    done = run_stages(plan)
    if published:
        publish(plan, done)
    return {d.located.folder for d in done}


def as_before(store: Path) -> None:
    """The lineage as older versions wrote it."""
    for path in (store / LINEAGE).glob("first-*.json"):
        path.write_text(json.dumps({"source": [str(Path(lineage(path)["source"][0]).parent)]}))


def left(folders: set[Path]) -> int:
    return sum(f.is_dir() for f in folders)


def test_one_persons_video_goes_and_the_others_stay(
    films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = tmp_path / "store"
    made = {p.stem: run(p, tmp_path / p.stem, store) for p in films.iterdir()}
    assert main(["store", "purge", "anna.mp4", "--out", str(tmp_path / "anna"), "--store", str(store)]) == 0
    assert [left(made[n]) for n in ("anna", "ben", "cleo")] == [0, 3, 3]
    said = capsys.readouterr().out
    assert f"yours to remove: {films / 'anna.mp4'}\n" in said and "ben" not in said and "not removed" not in said


def test_a_store_of_an_older_version_names_the_folder_alone(
    films: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What anna's run published goes; cleo's, of which no published folder is, may be of either and is told."""
    store = tmp_path / "store"
    made = {p.stem: run(p, tmp_path / p.stem, store, published=p.stem != "cleo") for p in films.iterdir()}
    as_before(store)
    assert main(["store", "purge", "anna.mp4", "--out", str(tmp_path / "anna"), "--store", str(store)]) == 0
    assert [left(made[n]) for n in ("anna", "ben", "cleo")] == [0, 3, 3]
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not removed")]
    assert len(told) == 1 and told[0].rpartition(": ")[2] in {str(p) for p in made["cleo"]}


@pytest.mark.parametrize("older", [False, True])
def test_a_folder_with_one_video_is_purged_by_the_folders_name(films: Path, tmp_path: Path, older: bool) -> None:
    store, folder = tmp_path / "store", tmp_path / "films/dora"
    folder.mkdir()
    (folder / "take.mp4").write_bytes(b"x" * 9)
    dora, ben = run(folder, tmp_path / "dora", store), run(films / "ben.mp4", tmp_path / "ben", store)
    if older:
        as_before(store)
    purge(belongings("dora", tmp_path / "dora", Store(store)), Store(store))
    assert left(dora) == 0 and left(ben) == 3


@pytest.mark.parametrize("capture", ["anna.mp4", "dora"])
def test_a_capture_of_a_batch_that_failed(films: Path, tmp_path: Path, capture: str) -> None:
    """It published nothing: its record names the capture."""
    out, store = tmp_path / "out", tmp_path / "out/.store"
    (films / "dora").mkdir()
    (films / "dora/take.mp4").write_bytes(b"x" * 9)
    mine = run(films / capture, out / "1", store, published=False)
    ben = run(films / "ben.mp4", out / "2", store, published=False)
    for name, at in (("1", capture), ("2", "ben.mp4")):
        BatchState(out / "batch").write(Entry(name=name, capture=str(films / at), state="failed"))
    found = belongings("1", out, Store(store))
    assert found.unsure == ()
    purge(found, Store(store))
    assert left(mine) == 0 and left(ben) == 3
