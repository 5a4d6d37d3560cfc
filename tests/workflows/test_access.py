"""The login of a server that we start, and the folders that its runs may use."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from prefect.context import FlowRunContext
from prefect.exceptions import TerminationSignal

from pipeline.errors import Cancelled, UsageError
from stages.registry import REGISTRY
from workflows import flows
from workflows.run.session import Session
from workflows.server import access
from workflows.server.access import CLIENT_LOGIN, CSRF, FILE_SETTINGS, ORIGINS, ROOTS, SERVER_LOGIN


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (SERVER_LOGIN, CLIENT_LOGIN, ORIGINS, CSRF, ROOTS, "NEUFACE_PARENT"):
        monkeypatch.setenv(name, "")  # so that what the test sets is undone
        monkeypatch.delenv(name)


def test_a_login_is_made_once_for_its_owner_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = access.lock_server(tmp_path, ["http://127.0.0.1:1"])
    assert path is not None and path.stat().st_mode & 0o777 == 0o600
    made = os.environ[SERVER_LOGIN]
    assert made == os.environ[CLIENT_LOGIN] == path.read_text().strip()
    assert made.startswith("neuface:") and len(made) >= 40
    assert (os.environ[ORIGINS], os.environ[CSRF]) == ("http://127.0.0.1:1", "true")
    monkeypatch.delenv(SERVER_LOGIN)
    path.chmod(0o644)
    access.lock_server(tmp_path, [])
    assert os.environ[SERVER_LOGIN] == made and path.stat().st_mode & 0o777 == 0o600
    (tmp_path / "other").mkdir()
    monkeypatch.delenv(SERVER_LOGIN)
    access.lock_server(tmp_path / "other", [])
    assert os.environ[SERVER_LOGIN] != made


def test_a_login_that_the_user_chose_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SERVER_LOGIN, "anna:secret")
    assert access.lock_server(tmp_path, []) is None
    assert os.environ[CLIENT_LOGIN] == "anna:secret" and not list(tmp_path.iterdir())


def test_paths_lie_below_the_allowed_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos, runs = tmp_path / "photos", tmp_path / "runs"
    for folder in (photos, runs, tmp_path / "photos2"):
        folder.mkdir()
    (runs / "out of it").symlink_to("/etc")
    good = {"capture": str(photos / "a"), "out": str(runs), "store": None}
    with pytest.raises(UsageError, match=ROOTS):  # nothing is allowed where nobody said what
        access.check_folders(good)
    monkeypatch.setenv(ROOTS, f"{photos}{os.pathsep}{runs}")
    access.check_folders(good)
    access.check_folders({"root": str(photos), "out": str(runs / "x"), "sets": ("bake.size=512",), "config": {}})
    for bad in (
        {"capture": "/etc"},
        {"capture": str(tmp_path / "photos2")},  # a name that begins alike
        {"out": str(runs / "../x")},
        {"out": str(runs / "out of it" / "x")},
        {"store": "/"},
        {"root": "relative"},
        {"sets": ("masks.model=/etc/x.onnx",)},
        {"config": {"inverse_rendering": {"prior_file": "/etc/x"}}},
        {"template": "/etc"},
        {"sets": ("template.folder=/etc",)},
    ):
        with pytest.raises(UsageError, match="may not use this path"):
            access.check_folders({**good, **bad})


def test_every_setting_that_names_a_file_is_known() -> None:
    told = {
        (stage.name, name)
        for stage in REGISTRY
        for config in stage.configs()
        for name, field in config.model_fields.items()
        if field.annotation is str and any(w in (field.description or "") for w in (" file", "checkpoint", "folder"))
    }
    digests = {(s, n) for s, n in told if n.endswith(("_sha256", "_digest"))}
    others = {("usd", "name"), ("usd", "texture_name")}  # names of files inside the asset
    assert told - digests - others == {(s, n) for s, names in FILE_SETTINGS.items() for n in names}


def test_serve_allows_the_named_folders_or_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    access.set_roots([])
    assert os.environ[ROOTS] == str(tmp_path)
    access.set_roots(["a", "/b"])
    assert os.environ[ROOTS] == f"{tmp_path}/a{os.pathsep}/b"
    access.set_roots([])
    assert os.environ[ROOTS] == f"{tmp_path}/a{os.pathsep}/b"


# ------------------------------------------------------------------ what a flow makes of it
@pytest.fixture
def from_server(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """As in a process that a worker started; the parents that the flow tied itself to."""
    parents: list[int] = []
    monkeypatch.setattr(FlowRunContext, "get", classmethod(lambda cls: SimpleNamespace(flow_run=None)))
    monkeypatch.setattr(flows, "end_with", parents.append)
    return parents


def test_a_run_from_a_server_is_bound_to_folders_and_to_its_worker(tmp_path: Path, from_server: list[int]) -> None:
    asked: dict[str, Any] = {"capture": str(tmp_path), "out": str(tmp_path / "o")}
    with pytest.raises(UsageError, match="may not use this path"):
        flows.capture_to_asset.fn(**asked)
    assert from_server == [os.getppid()] and not (tmp_path / "o").exists()
    with flows._watched(asked, Session()):  # `neuface run` on a server: the user's own process
        pass
    assert len(from_server) == 1


def test_a_signal_to_a_run_from_a_server_ends_it_in_order(
    tmp_path: Path, from_server: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ROOTS, str(tmp_path))
    with pytest.raises(TerminationSignal) as e, flows._watched({"out": str(tmp_path)}) as watch:
        os.kill(os.getpid(), 15)
        assert watch.stop.wait(60)
        raise Cancelled("at a checkpoint")
    assert e.value.signal == 15
