"""A mistyped option, command or choice is answered with the word that was meant; and the last words of a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from workflows.cli.main import main
from workflows.cli.numbers import number, whole, whole_list
from workflows.cli.summary import summary


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("rnu photos", "did you mean run?"),
        ("run photos --presett draft", "unknown option --presett; did you mean --preset?"),
        ("run photos --oot runs", "unknown option --oot; did you mean --out?"),
        ("run photos --out runs --holdoot=every:5:2", "did you mean --holdout?"),
        ("--verbsoe run photos", "did you mean --verbose?"),
        ("store gcc x", "did you mean gc?"),
    ],
)
def test_what_was_meant(arguments: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as e:
        main(arguments.split())
    assert e.value.code == 2
    assert said in capsys.readouterr().err


def test_what_is_like_nothing_gets_no_guess(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "photos", "--qqqqqq", "1"])
    err = capsys.readouterr().err
    assert "unknown option --qqqqqq" in err and "did you mean" not in err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--preset", "drfat"], "did you mean draft?"),
        (["--set", "frist.plus=1"], "did you mean first?"),
        (["--set", "first.puls=1"], "did you mean plus?"),
        (["--until", "secnd"], "did you mean second?"),
    ],
)
@pytest.mark.usefixtures("toys")
def test_names_in_a_request(photos: Path, options: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(photos), "--out", str(photos.parent / "out"), *options]) == 2
    assert said in capsys.readouterr().err


def test_an_abbreviated_option_and_a_value_after_an_equals_sign_are_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["settings", "masks", "--js"]) == 0
    assert json.loads(capsys.readouterr().out)
    assert main(["settings", "--", "--json"]) == 2  # after -- it is a name
    assert "--json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("schedule RUN --gpus a,b", "--gpus"),
        ("schedule RUN --gpus 1,,8", "--gpus"),
        ("schedule RUN --gpus 0", "--gpus"),
        ("schedule RUN --captures -5", "--captures"),
        ("schedule RUN --captures 99999999999999999999", "--captures"),
        ("schedule RUN --workers 0", "--workers"),
        ("schedule RUN --lost 1.5", "--lost"),
        ("schedule RUN --link 0", "--link"),
        ("schedule RUN --spread nan", "--spread"),
        ("schedule RUN --fit-seconds inf", "--fit-seconds"),
        ("serve --server-only --port 99999999", "--port"),
        ("serve --server-only --port 0", "--port"),
        ("serve --limit 0", "--limit"),
        ("batch tree --out o --workers ten", "--workers"),
        ("demo --views 7", "--views"),
    ],
)
def test_numbers_outside_of_their_limits_are_wrong_usage(
    arguments: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as e:
        main(arguments.split())
    assert e.value.code == 2
    said = capsys.readouterr().err
    assert f"argument {option}" in said and " number " in said


def test_numbers_within_their_limits() -> None:
    assert whole(1, 65535)("65535") == 65535 and whole(0)("0") == 0
    assert whole_list(1, 100)("1, 8,64") == (1, 8, 64)
    assert number(0)("0") == 0 and number(0, 0.9)("0.9") == 0.9 and number(0, above=True)("1e-3") == 1e-3


# ------------------------------------------------------------------ the summary
def test_the_last_words_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "report").mkdir()
    (tmp_path / "report/index.html").write_text("")
    holdout = {"views": 5, "held_out": True, "psnr": 31.24, "asset_psnr": 29.87}
    (tmp_path / "report/metrics.json").write_text(json.dumps({"holdout": holdout}))
    stages = {n: {"reused": n == "bake"} for n in ("bake", "report")}
    verdict = {"level": "good", "stages": {"bake": "good"}, "findings": []}
    record = {"asset": "asset/anna.usda", "stages": stages, "verdict": verdict}
    assert summary(record, tmp_path, ["chamfer 0.3 mm"]) == [
        f"asset  {tmp_path}/asset/anna.usda",
        f"report {tmp_path}/report/index.html",
        f"run    {tmp_path}/run.json (2 stages, 1 reused)",
        f"look at it: neuface view {tmp_path}",
        "against the demo's ground truth:",
        "  chamfer 0.3 mm",
        "PSNR of 5 held-out views: model 31.2 dB, exported asset 29.9 dB",
        "verdict: good",
    ]


def test_a_run_without_a_report_has_no_figures_and_nothing_to_view(tmp_path: Path) -> None:
    record = {"stages": {"capture": {"reused": False}}, "verdict": {"level": "good", "stages": {}, "findings": []}}
    assert summary(record, tmp_path) == [f"run    {tmp_path}/run.json (1 stages, 0 reused)", "verdict: good"]


def test_damaged_figures_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "report").mkdir()
    record = {"stages": {"report": {"reused": False}}, "verdict": {"level": "good", "stages": {}, "findings": []}}
    for text in ("{", "[]", '{"holdout": 3}', '{"holdout": {"psnr": null}}'):
        (tmp_path / "report/metrics.json").write_text(text)
        assert summary(record, tmp_path)[-1] == "verdict: good" and len(summary(record, tmp_path)) == 2
