"""Findings, their limits and the worst of them."""

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from pipeline.verdict import Finding, Limits, Verdict, judged, verdict_of, verdict_of_inputs, worst


@pytest.mark.parametrize(
    ("value", "level"),
    [(0.9, "good"), (0.89, "usable"), (0.5, "usable"), (0.49, "unusable"), (float("nan"), "unusable")],
)
def test_a_lower_limit(value: float, level: str) -> None:
    assert Limits(0.9, 0.5).level(value) == level


@pytest.mark.parametrize(("value", "level"), [(1, "good"), (1.1, "usable"), (3, "usable"), (3.1, "unusable")])
def test_an_upper_limit(value: float, level: str) -> None:
    assert Limits(1, 3, lower=False).level(value) == level


@pytest.mark.parametrize(("good", "usable", "lower"), [(0.5, 0.9, True), (3, 1, False)])
def test_limits_in_the_wrong_order_are_refused(good: float, usable: float, lower: bool) -> None:
    with pytest.raises(ValueError, match="not be stricter"):
        Limits(good, usable, lower)


def test_a_good_finding_names_no_photos_and_no_remedy() -> None:
    good = judged("sharp", 0.95, Limits(0.9, 0.5), "95 % are sharp.", "use a tripod", views=["a.jpg"])
    bad = judged("sharp", 0.2, Limits(0.9, 0.5), "20 % are sharp.", "use a tripod", views=["a.jpg"])
    assert (good.level, good.remedy, good.views) == ("good", "", ())
    assert (bad.level, bad.remedy, bad.views) == ("unusable", "use a tripod", ("a.jpg",))
    assert str(bad) == "unusable: 20 % are sharp (a.jpg). What to do: use a tripod."


def test_the_worst_of_findings_and_levels() -> None:
    good = judged("a", 1.0, Limits(0.5, 0.5), "fine.", "")
    assert worst([]) == "good"
    assert worst([good, "usable"]) == "usable"
    assert worst(["usable", "unusable", good]) == "unusable"


def test_a_finding_survives_json() -> None:
    found = judged("a", float("inf"), Limits(0.5, 0.5), "not finite.", "look")
    assert Finding.model_validate_json(found.model_dump_json()) == found
    assert found.value is None


def test_a_sentence_ends_once_however_it_was_written() -> None:
    for said, remedy in (("20 % are sharp", "use a tripod"), ("20 % are sharp.", "use a tripod.")):
        assert judged("a", 0.2, Limits(0.9, 0.5), said, remedy).sentence == "20 % are sharp. What to do: use a tripod."


# ------------------------------------------------------------------ several stages
def some() -> Verdict:
    limits = Limits(0.9, 0.5)
    found = {level: judged(level, value, limits, f"{level}.", "act") for level, value in
             (("good", 0.95), ("usable", 0.7), ("unusable", 0.2))}  # fmt: skip
    return Verdict({"a": (found["good"], found["usable"]), "b": (), "c": (found["unusable"], found["usable"])})


def test_the_verdict_of_several_stages_is_the_worst_and_lists_the_worst_first() -> None:
    verdict = some()
    assert verdict.level == "unusable"
    assert verdict.stages == {"a": "usable", "b": "good", "c": "unusable"}
    assert [(s, f.level) for s, f in verdict.troubles()] == [("c", "unusable"), ("a", "usable"), ("c", "usable")]
    assert verdict.reasons()[0] == "c: unusable: unusable. What to do: act."
    assert Verdict({}).level == "good" and Verdict({}).reasons() == ()


def test_a_record_has_the_troubles_or_all() -> None:
    verdict = some()
    assert [f["level"] for f in verdict.record()["findings"]] == ["unusable", "usable", "usable"]
    assert [(f["stage"], f["level"]) for f in verdict.record(every=True)["findings"]] == [
        ("a", "good"), ("a", "usable"), ("c", "unusable"), ("c", "usable")]  # fmt: skip
    content = {k: v for k, v in verdict.record()["findings"][0].items() if k != "stage"}
    assert Finding.model_validate(content) == verdict.findings["c"][0]


def test_artifacts_without_findings_are_good_and_a_stage_adds_its_own() -> None:
    @dataclass
    class Inputs:
        a: object
        b: object

    findings = some().findings
    inputs = Inputs(*(SimpleNamespace(artifact=SimpleNamespace(findings=findings[n])) for n in ("a", "b")))
    assert verdict_of({"old": object()}).level == "good"
    assert verdict_of_inputs(inputs).level == "usable"
    verdict = verdict_of_inputs(inputs, c=findings["c"])
    assert (verdict.level, list(verdict.stages)) == ("unusable", ["a", "b", "c"])
