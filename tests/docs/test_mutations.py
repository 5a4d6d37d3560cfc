"""The list of wrong changes fits the code; whether they are noticed is for `python -m benchmarks.mutations` to say."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.mutation import Mutation
from benchmarks.mutation_list import MUTATIONS
from benchmarks.mutations import KILLED, NOT_RUN, PAGE, PARTS, chosen, fate, main, page, recorded

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: m.change)
def test_each_change_can_be_made_and_has_its_tests(mutation: Mutation) -> None:
    text = (ROOT / mutation.file).read_text()
    assert text.count(mutation.before) == 1 and mutation.before != mutation.after
    if mutation.file.endswith(".py"):  # its own tests compile the other
        compile(text.replace(mutation.before, mutation.after), mutation.file, "exec")
    file, _, name = mutation.tests.partition("::")
    source = (ROOT / file).read_text()
    assert f"def {name or 'test_'}" in source
    above = source.partition(f"def {name}(")[0].rpartition("\n\n\n")[2] if name else ""
    assert "mark.slow" not in above, "benchmarks/mutations.py runs the quick tests"


def test_the_list_spans_the_product() -> None:
    assert len(MUTATIONS) >= 60 and len({m.change for m in MUTATIONS}) == len(MUTATIONS)
    assert {m.file.split("/")[0] for m in MUTATIONS} == {"pipeline", "stages", "workflows"} <= set(PARTS)


def test_the_page_says_what_was_measured_and_none_survived() -> None:
    """Made by --write; a change that was never made says so."""
    assert PAGE.read_text() == page()
    assert set(recorded()) <= {KILLED, NOT_RUN}


@pytest.mark.parametrize(
    ("test", "expected"),
    [
        ("assert f() == 2", "killed"),
        ("assert f() > 0", "survived"),
        ("import nothing_of_that_name", "unclear"),
    ],
)
def test_a_change_is_killed_only_by_a_test_that_fails_and_is_taken_back(
    tmp_path: Path, test: str, expected: str
) -> None:
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\nmarkers = ['slow: slow']\n")
    code = tmp_path / "code_to_change.py"
    code.write_text("def f():\n    return 1 + 1\n")
    before = code.stat().st_mtime_ns
    body = test if test.startswith("import") else f"from code_to_change import f\n\n\ndef test_f():\n    {test}"
    (tmp_path / "test_it.py").write_text(body + "\n")
    assert fate(tmp_path, Mutation("code_to_change.py", "1 + 1", "1 + 2", "test_it.py"))[0] == expected
    assert code.read_text() == "def f():\n    return 1 + 1\n" and code.stat().st_mtime_ns == before
    assert fate(tmp_path, Mutation("code_to_change.py", "1 + 7", "1", "test_it.py"))[0] == "unclear"


def test_a_run_may_leave_out_what_was_killed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fates = [KILLED, "survived", NOT_RUN] + [KILLED] * (len(MUTATIONS) - 3)
    monkeypatch.setattr("benchmarks.mutations.recorded", lambda: fates)
    assert chosen(left=True) == list(MUTATIONS[1:3]) and len(chosen()) == len(MUTATIONS)
    assert chosen(["stages/uv/"]) == [m for m in MUTATIONS if m.file.startswith("stages/uv/")] != []
    assert chosen(["stages/uv/"], left=True) == []
    assert main(["--left", "--only", "stages/uv/"]) == 0 and "nothing is left" in capsys.readouterr().out


def test_a_choice_without_changes_is_refused() -> None:
    with pytest.raises(SystemExit) as e:
        main(["--only", "no such name"])
    assert e.value.code == 2
