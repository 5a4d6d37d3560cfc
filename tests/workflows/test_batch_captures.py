"""Which captures a batch has: trees, filters and lists."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import StageError, UsageError
from tests.support.scripted_batch import capture_tree, go
from workflows.batch import captures
from workflows.batch.captures import NAME, find, ranges
from workflows.batch.request import BatchRequest, asset_name
from workflows.batch.state import BatchState


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    return capture_tree(tmp_path)


def test_a_tree_in_natural_order_and_its_filters(tree: Path) -> None:
    names = [i.name for i in find(tree)]
    assert names == ["1/1_neutral", "1/2_smile", "2/1_neutral", "10/1_neutral", "10/16_grin"]
    assert [i.name for i in find(tree, "1-2")] == names[:3]
    assert [i.name for i in find(tree, "2,10", "1")] == ["2/1_neutral", "10/1_neutral"]
    assert [i.name for i in find(tree, None, "2-16")] == ["1/2_smile", "10/16_grin"]


def test_photos_without_params_are_a_fault_and_not_passed_over(tree: Path) -> None:
    (tree / "2/1_neutral/params.json").unlink()
    item = next(i for i in find(tree) if i.name == "2/1_neutral")
    assert item.fault is not None and "params.json is missing" in item.fault


ODD_NAMES = [
    "12 b/1_neutral",
    "3/1 smile",
    "Jörg/1_neutral",
    "3/schön",
    "-x/1",
    "4/" + "a" * 70,
    "5/a\nb",
    "6/b\udcff",
]


@pytest.mark.parametrize("place", ODD_NAMES)
@pytest.mark.parametrize("cameras", [True, False])
def test_a_folder_whose_name_no_result_can_have_is_a_fault_of_its_own(tree: Path, place: str, cameras: bool) -> None:
    """The others run; its record and its line in the table have a name that is near to the folder's."""
    folder = tree / place
    folder.mkdir(parents=True)
    (folder / ("params.json" if cameras else "0.jpg")).write_text("{}")
    (odd,) = (i for i in find(tree) if i.fault is not None)
    assert NAME.fullmatch(odd.name) and odd.fault is not None and "rename it" in odd.fault
    assert ascii(place.split("/")[0])[1:-1] in ascii(odd.fault)
    summary, runner = go(tree, {})
    assert len(runner.started) == 5 and summary.counts()["failed"] == 1
    entry = BatchState(tree.parent / "out/batch").read(odd)
    assert entry.state == "failed" and entry.fault is not None and entry.fault.message == odd.fault


def test_two_odd_names_with_the_same_letters_are_two_captures(tree: Path) -> None:
    for name in ("Jörg", "Järg"):
        (tree / name / "1").mkdir(parents=True)
        (tree / name / "1/params.json").write_text("{}")
    assert len(find(tree)) == 7 and len(find(tree, "1-10")) == 5


@pytest.mark.parametrize("text", ["", "a", "3-1", "1,,2", "-1", "1-2-3", "1 2"])
def test_filters_that_can_not_be_read(tree: Path, text: str) -> None:
    with pytest.raises(UsageError, match="filter"):
        find(tree, text)


@given(st.lists(st.tuples(st.integers(0, 999), st.integers(0, 99)), min_size=1, max_size=5))
def test_ranges_read_back_what_was_written(pairs: list[tuple[int, int]]) -> None:
    wanted = [(low, low + more) for low, more in pairs]
    assert ranges(",".join(f"{a}-{b}" if a < b else f"{a}" for a, b in wanted), "--x") == wanted


def test_nothing_left_by_the_filters_and_nothing_at_all(tree: Path, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="5 found, 0 left"):
        find(tree, "77")
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "gone", tree / "1/1_neutral/params.json.txt"):
        with pytest.raises(StageError):
            find(place)


def test_lists_in_csv_and_json_are_the_same(tree: Path) -> None:
    rows = [{"capture": "1/1_neutral", "subject": "1", "expression": "1_neutral"},
            {"capture": str(tree / "2/1_neutral"), "name": "anna", "preset": "studio", "seed": 3}]  # fmt: skip
    (tree / "a.json").write_text(json.dumps(rows))
    with (tree / "a.csv").open("w") as f:
        table = csv.DictWriter(f, ["capture", "name", "subject", "expression", "preset", "seed"])
        table.writeheader()
        table.writerows(rows)
    first, second = find(tree / "a.json"), find(tree / "a.csv")
    assert first == second
    assert [(i.name, i.capture, i.own) for i in first] == [
        ("1/1_neutral", tree / "1/1_neutral", {}),
        ("anna", tree / "2/1_neutral", {"preset": "studio", "seed": 3}),
    ]


@pytest.mark.parametrize(
    "rows",
    ["[1", "{}", "3", '[{"name": "a"}]', '[{"capture": ""}]', '[{"capture": "x", "sed": 1}]', "[" * 100_000,
     '[{"capture": "x", "seed": -1}]', '[{"capture": "x"}, {"capture": "y/x"}]'],
)  # fmt: skip
def test_lists_that_can_not_be_read(tmp_path: Path, rows: str) -> None:
    (tmp_path / "a.json").write_text(rows)
    with pytest.raises(UsageError):
        find(tmp_path / "a.json")


ESCAPES = ["../x", "/etc/x", "a/../../b", "..", ".", "a/b/c", ".hidden", "a/.x", "a\\..\\b", "", " ", "a\nb", "a/", "~",
           "batch", "batch/index.html", "é" * 3, "a" * 65, "-rf"]  # fmt: skip


@pytest.mark.parametrize("name", ESCAPES)
def test_names_from_a_list_never_leave_the_out_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps([{"capture": "x", "name": name}]))
    try:
        assert [i.name for i in find(tmp_path / "a.json")] == ["x"]  # an empty name is none: the folder's is taken
        assert name in ("", " ")
    except UsageError:
        pass


@given(st.text(max_size=20))
def test_every_name_that_passes_stays_inside(name: str) -> None:
    if NAME.fullmatch(name):
        out = Path("/runs/out")
        assert out in (out / name).resolve().parents
        assert asset_name(name).isidentifier()


def test_records_folder_is_the_reserved_name() -> None:
    assert BatchRequest(root="r", out="/o").folder == Path("/o") / captures.RECORDS
