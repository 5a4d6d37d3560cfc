"""Findings, their limits and the worst of them."""

import pytest

from pipeline.verdict import Finding, Limits, judged, worst


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
    with pytest.raises(ValueError, match="no stricter"):
        Limits(good, usable, lower)


def test_a_good_finding_names_no_photos_and_no_remedy() -> None:
    good = judged("sharp", 0.95, Limits(0.9, 0.5), "95 % are sharp.", "use a tripod", views=["a.jpg"])
    bad = judged("sharp", 0.2, Limits(0.9, 0.5), "20 % are sharp.", "use a tripod", views=["a.jpg"])
    assert (good.level, good.remedy, good.views) == ("good", "", ())
    assert (bad.level, bad.remedy, bad.views) == ("unusable", "use a tripod", ("a.jpg",))
    assert str(bad) == "unusable: 20 % are sharp. (a.jpg) What to do: use a tripod."


def test_the_worst_of_findings_and_levels() -> None:
    good = judged("a", 1.0, Limits(0.5, 0.5), "fine.", "")
    assert worst([]) == "good"
    assert worst([good, "usable"]) == "usable"
    assert worst(["usable", "unusable", good]) == "unusable"


def test_a_finding_survives_json() -> None:
    found = judged("a", float("inf"), Limits(0.5, 0.5), "not finite.", "look")
    assert Finding.model_validate_json(found.model_dump_json()) == found
    assert found.value is None
