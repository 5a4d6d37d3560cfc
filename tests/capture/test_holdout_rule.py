"""Which views a hold-out rule names."""

from __future__ import annotations

import pytest

from pipeline.errors import UsageError
from stages.capture.holdout import check_rule, held_out

VIEWS = [(i, f"{i}.jpg") for i in range(12)] + [(31, "extra.png")]


@pytest.mark.parametrize(
    ("rule", "indices"),
    [
        ("none", set()),
        ("every:5:2", {2, 7}),
        ("every:1:0", {i for i, _ in VIEWS}),
        ("every:30:1", {1, 31}),
        ("names:3.jpg,extra", {3, 31}),
        ("names: 4 , 4.jpg", {4}),
    ],
)
def test_rules(rule: str, indices: set[int]) -> None:
    assert held_out(rule, VIEWS) == indices


@pytest.mark.parametrize(
    "rule", ["", "some", "every:5", "every:5:5", "every:0:0", "every:-1:0", "names:", "names:a,,b"]
)
def test_grammar(rule: str) -> None:
    with pytest.raises(UsageError, match="every:N:K"):
        check_rule(rule)


def test_unknown_names_are_refused_and_known_absent_ones_are_not() -> None:
    with pytest.raises(UsageError, match="nobody.jpg"):
        held_out("names:1.jpg,nobody.jpg", VIEWS)
    assert held_out("names:1.jpg,invalid.jpg", VIEWS, absent=["invalid.jpg"]) == {1}
