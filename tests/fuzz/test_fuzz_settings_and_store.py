"""Damaged settings files, lists of captures, and what lies in the store."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.artifacts import FileRef
from pipeline.capture_artifacts import CaptureSource
from pipeline.store import LINEAGE, MANIFEST, RUN, Store, lineage
from stages.presets import read_config_file
from tests.support.fuzzing import bounded, fuzzed
from tests.support.mutations import WORDS, as_json, damaged, damages, nonsense, replaced, reworded, swaps
from workflows.batch.captures import find
from workflows.run.plan import check_settings
from workflows.run.request import RunRequest

SETTINGS = {"bake": {"size": 2048}, "poses": {"check": True, "given": "refine", "given_deviation": 0.01},
            "capture": {"holdout": "every:5:2", "min_views": 4}, "usd": {"name": "anna", "author": "A"}}  # fmt: skip
TOML = '[bake]\nsize = 2048\n[poses]\ncheck = true\ngiven_deviation = 0.01\n[capture]\nholdout = "every:5:2"\n'
KEY = "0" * 64


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("place")


def check_file(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    with bounded():
        config = read_config_file(path)
        configs = check_settings(RunRequest(capture="c", out="o", config=config))
        json.dumps({n: c.model_dump(mode="json") for n, c in configs.items()}, allow_nan=False).encode()


@pytest.mark.parametrize("suffix", [".toml", ".json"])
@given(how=damages)
@fuzzed
def test_damaged_settings(place: Path, suffix: str, how: list) -> None:
    check_file(place / f"s{suffix}", damaged(TOML.encode() if suffix == ".toml" else as_json(SETTINGS), how))


@given(how=nonsense)
@fuzzed
def test_nonsense_in_settings(place: Path, how: list) -> None:
    check_file(place / "s.json", as_json(replaced(SETTINGS, how)))


@given(how=swaps)
@fuzzed
def test_nonsense_in_toml(place: Path, how: list) -> None:
    check_file(place / "s.toml", reworded(TOML, how, r"\w+|\"[^\"]*\"").encode("utf-8", "surrogatepass"))


@pytest.mark.parametrize("data", [b"[" * 100_000, b'{"bake":' * 100_000, b"a = " + b"[" * 100_000, b"x" * 2_000_000])
@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_deep_and_large_settings(place: Path, suffix: str, data: bytes) -> None:
    check_file(place / f"deep{suffix}", data)


@given(value=st.sampled_from(WORDS) | st.text(max_size=30), key=st.sampled_from(["bake.size", "usd.name", "poses.x"]))
@fuzzed
def test_single_values(value: str, key: str) -> None:
    with bounded():
        check_settings(RunRequest(capture="c", out="o", sets=(f"{key}={value}", f"bake.size=[{value}")))


@pytest.mark.parametrize("suffix", [".csv", ".json"])
@given(how=damages, words=swaps)
@fuzzed
def test_damaged_lists_of_captures(place: Path, suffix: str, how: list, words: list) -> None:
    rows = [{"capture": "a", "name": "one", "subject": "1"}, {"capture": "b", "name": "two", "seed": 3}]
    text = "capture,name,seed\na,one,1\nb,two,2\n" if suffix == ".csv" else json.dumps(rows)
    path = place / f"list{suffix}"
    path.write_bytes(damaged(reworded(text, words, r"\w+").encode("utf-8", "surrogatepass"), how))
    with bounded():
        find(path)


# ------------------------------------------------------------------ the store
@pytest.fixture(scope="module")
def stored(place: Path) -> SimpleNamespace:
    """One artifact with a file in a store, and the bytes of its records."""
    store = Store(place / "store")
    store.trace("capture", KEY, {"source": place})
    partial = store.begin("capture", KEY)
    (partial / "a.jpg").write_bytes(b"photo")
    source = CaptureSource(kind="photos", photos=(FileRef.of(partial, "a.jpg"),), passed_over=("x.heic",))
    store.finish("capture", KEY, partial, source, {"seconds": 1.5, "config": {"a": 1}})
    folder = store.folder("capture", KEY)
    return SimpleNamespace(store=store, folder=folder, files={n: (folder / n).read_bytes() for n in (MANIFEST, RUN)})


def check_store(stored: SimpleNamespace, manifest: bytes, run: bytes) -> None:
    stored.folder.mkdir(exist_ok=True)
    for name, data in ((MANIFEST, manifest), (RUN, run), ("a.jpg", b"photo")):
        (stored.folder / name).write_bytes(data)
    with bounded():
        assert float(stored.store.load_run("capture", KEY).get("seconds", 0.0)) >= 0
        found = stored.store.load("capture", KEY, CaptureSource)
        if found is None:
            assert not stored.folder.exists()  # set aside and told: it is made anew
        else:
            found.artifact.digest()


@given(how=damages)
@fuzzed
def test_damaged_records_of_the_store(stored: SimpleNamespace, how: list) -> None:
    check_store(stored, *(damaged(d, how) for d in stored.files.values()))
    path = stored.store.root / LINEAGE / "damaged.json"
    path.write_bytes(damaged(b'{"source": ["/a", "/b"], "capture": ["x/y"]}', how))
    assert all(isinstance(f, str) for names in lineage(path).values() for f in names)


@pytest.mark.slow
@given(how=nonsense)
@fuzzed
def test_nonsense_in_the_records_of_the_store(stored: SimpleNamespace, how: list) -> None:
    check_store(stored, *(as_json(replaced(json.loads(d), how)) for d in stored.files.values()))
