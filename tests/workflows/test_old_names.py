"""Names of settings that an earlier version had: a hint for one release, no error."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from pipeline.errors import UsageError
from stages import old_names
from stages.presets import configs_for, parse_sets
from stages.registry import REGISTRY
from tests.support.toy_stages import TOYS

Messages = pytest.LogCaptureFixture


@pytest.fixture(autouse=True)
def as_if_nothing_was_told() -> Iterator[None]:
    old_names._hint.cache_clear()
    yield
    old_names._hint.cache_clear()


@pytest.mark.parametrize("path", sorted(old_names.REMOVED))
def test_a_removed_one_is_ignored_with_a_hint(path: str, caplog: Messages) -> None:
    configs = configs_for("draft", parse_sets([f"{path}=1"]))
    assert configs == configs_for("draft", {})
    assert len(caplog.messages) == 1
    assert f"--set {path} is no longer a setting and was ignored" in caplog.text


def test_the_hint_comes_once_and_from_a_file_too(caplog: Messages) -> None:
    for _ in range(2):
        configs_for("draft", {}, {"poses": {"use_masks": False, "seed": 3}})
    assert len(caplog.messages) == 1 and "--config poses.use_masks" in caplog.text
    assert configs_for("draft", {}, {"poses": {"use_masks": 0, "seed": 3}})["poses"].model_dump()["seed"] == 3


def test_a_renamed_one_sets_the_new_one_which_wins(caplog: Messages, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(old_names.RENAMED, "first.add", "plus")
    assert configs_for("draft", parse_sets(["first.add=7"]), registry=TOYS)["first"].model_dump()["plus"] == 7
    assert "first.add is now named first.plus" in caplog.text
    both = parse_sets(["first.add=7", "first.plus=8"])
    assert configs_for("draft", both, registry=TOYS)["first"].model_dump()["plus"] == 8


@pytest.mark.parametrize(
    ("path", "value"),
    [("capture.chart", "on"), ("poses.patience", 2), ("masks.mend", False), ("inverse_rendering.relief", "off"),
     ("inverse_rendering.even_until", 0.4), ("inverse_rendering.shininess", 0.5), ("inverse_rendering.parsimony", 0.5)],
)  # fmt: skip
def test_each_renamed_setting_still_sets_what_it_set(path: str, value: object, caplog: Messages) -> None:
    stage, _, name = path.partition(".")
    configs = configs_for("draft", parse_sets([f"{path}={value}"]))
    assert configs[stage].model_dump()[old_names.RENAMED[path]] == value
    assert f"--set {path} is now named {stage}.{old_names.RENAMED[path]}" in caplog.text


def test_the_renamed_settings_are_the_ones_tested_above() -> None:
    assert len(old_names.RENAMED) == 7


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [(path, old, new) for path, values in old_names.RENAMED_VALUES.items() for old, new in values.items()],
)
def test_a_renamed_value_is_the_new_one(path: str, old: str, new: str, caplog: Messages) -> None:
    stage, _, name = path.partition(".")
    assert configs_for("draft", parse_sets([f"{path}={old}"]))[stage].model_dump()[name] == new
    assert f"is now named {path}={new};" in caplog.text


def test_a_name_that_never_was_stays_an_error(caplog: Messages) -> None:
    with pytest.raises(UsageError, match="unknown setting of poses"):
        configs_for("draft", parse_sets(["poses.use_mask=1"]))
    assert not caplog.messages


def test_no_old_name_is_a_setting_of_today() -> None:
    today = {f"{s.name}.{name}" for s in REGISTRY for name in s.config.model_fields}
    assert not today & (old_names.REMOVED | old_names.RENAMED.keys())
    assert {f"{path.split('.')[0]}.{new}" for path, new in old_names.RENAMED.items()} <= today
