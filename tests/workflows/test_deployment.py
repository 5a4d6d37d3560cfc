"""A real server, a real worker, a deployment run of the real first stage: all on this machine, over loopback."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from pipeline.images import write_png
from tests.support.facescape_tree import write_tree
from tests.support.points import PATIENCE, wait_for
from tests.support.servers import ASKED_EVERY, LOGIN, ask, descendants, free_port, guarded, login_headers, wait_healthy
from workflows.batch.request import BatchRequest
from workflows.run.request import RunRequest

PREFECT = Path(sys.executable).parent / "prefect"
CLOSED = {"job_configuration": {"namespace": "x"}, "variables": {"properties": {}, "additionalProperties": False}}


def call(environment: dict[str, str], *arguments: object, cwd: Path, code: int = 0) -> str:
    done = subprocess.run([PREFECT, *map(str, arguments)], env=environment, cwd=cwd, text=True, capture_output=True,
                          timeout=PATIENCE)  # fmt: skip
    assert done.returncode == code, f"{arguments}: {done.stdout}\n{done.stderr}"
    return done.stdout


def submit(environment: dict[str, str], deployment: str, asked: dict[str, object], *options: str, cwd: Path) -> None:
    """`prefect deployment run` with these parameters; text as it is, the rest as JSON."""
    words = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in asked.items()]
    call(environment, "deployment", "run", deployment, *(x for w in words for x in ("--param", w)), *options, cwd=cwd)


def refused(environment: dict[str, str], url: str, tmp_path: Path, deployment: str) -> None:
    """Nobody without the login starts a run, and nobody with it gives a run a command, an environment or a folder."""
    path, trace = f"/deployments/{deployment}/create_flow_run", tmp_path / "trace"
    asked = {"capture": str(tmp_path / "photos"), "out": str(tmp_path / "x"), "until": "capture"}
    variables: dict[str, object] = {
        "command": f"touch {trace}", "env": {"PYTHONPATH": str(tmp_path)}, "working_dir": str(tmp_path),
        "env.PYTHONPATH": str(tmp_path), "name": "x", "image": "x", "stream_output": False,
    }  # fmt: skip
    for name, value in variables.items():
        with pytest.raises(urllib.error.HTTPError) as e:
            ask(url, path, {"parameters": asked, "job_variables": {name: value}}, LOGIN)
        assert e.value.code == 422, name
    for login, code in ((None, 403), ("tests:wrong", 401)):  # without the token; without the login for one
        with pytest.raises(urllib.error.HTTPError) as e:
            ask(url, path, {"parameters": asked}, login)
        assert e.value.code == code
    outside = call(environment, "deployment", "run", "capture-to-asset/local", "--param", f"capture={tmp_path}/photos",
                   "--param", "out=/tmp/../etc/neuface", "--watch", cwd=tmp_path, code=1)  # fmt: skip
    assert "/etc/neuface" in outside and not Path("/etc/neuface").exists() and not trace.exists()


@contextmanager
def running(environment: dict[str, str], log: Path, *arguments: object, cwd: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as f:
        child = subprocess.Popen([PREFECT, *map(str, arguments)], env=environment, cwd=cwd, stdout=f,
                                 stderr=subprocess.STDOUT, start_new_session=True)  # fmt: skip
    try:
        yield child
    finally:
        os.killpg(child.pid, signal.SIGTERM)
        try:
            child.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()


@pytest.mark.slow
def test_deployment_run_on_a_server_with_a_worker(
    tmp_path: Path, repo: Path, child_environment: dict[str, str]
) -> None:
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for i in range(4):
        write_png(photos / f"{i}.png", np.random.default_rng(i).uniform(0, 1, (96, 128, 3)))
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    environment = {
        **child_environment,
        **guarded(),
        "PREFECT_API_URL": url,
        "PREFECT_HOME": str(tmp_path / "home"),
        "NEUFACE_ROOTS": f"{tmp_path}{os.pathsep}/nowhere",
    }
    with running(
        environment, tmp_path / "server.log", "server", "start", "--host", "127.0.0.1", "--port", port, cwd=repo
    ):
        wait_healthy(url)
        for kind, end in (("process", ""), ("docker", "-docker"), ("kubernetes", "-kubernetes")):
            template = tmp_path / "job.json" if kind == "kubernetes" else repo / f"workflows/pools/{kind}.json"
            if kind == "kubernetes":
                template.write_text(json.dumps(CLOSED))
            for pool in ("heads", "batches"):
                call(environment, "work-pool", "create", f"{pool}{end}", "--type", kind, "--base-job-template",
                     template, cwd=repo)  # fmt: skip
        names = [x for end in ("local", "docker", "kubernetes") for x in ("-n", end, "-n", f"batch-{end}")]
        call(environment, "--no-prompt", "deploy", "--prefect-file", "workflows/prefect.yaml", *names, cwd=repo)
        deployed = {d["name"]: d for d in ask(url, "/deployments/filter", {}, LOGIN)}
        with running(
            environment, tmp_path / "worker.log", "worker", "start", "--pool", "heads", "--limit", 1, cwd=tmp_path
        ):
            good = {
                "capture": str(photos), "out": str(out), "preset": "studio", "holdout": "every:4:3", "name": "anna",
                "seed": 7, "device": "cpu", "until": "capture", "from_stage": "capture", "fit_slots": "gpus",
                "sets": ["capture.min_views=3"], "config": {"capture": {"drop_blurred": False}},
                "store": str(tmp_path / "store"), "stage_limit": 600.0, "budget": None,  # with a preset there is none
                "force": True, "strict": True, "pack": "zip", "template": None, "light": None, "also": None,
                "no_exr_views": True, "keep_all": True, "no_live": True,
            }  # fmt: skip
            submit(environment, "capture-to-asset/local", good, "--watch", cwd=tmp_path)
            many = {
                "root": "/photos", "out": "/runs", "subjects": "1-40", "expressions": "1,2", "preset": "film",
                "holdout": "every:5:2", "seed": 3, "device": "cuda", "until": "bake", "sets": ["bake.size=512"],
                "config": {"uv": {"padding": 8}}, "store": "/runs/.store", "stage_limit": 60.0, "attempts": 5,
                "force": True, "strict": True, "pack": "zip", "template": "/templates/studio",
                "neutral": "1_neutral", "average": True,
                "deployment": "capture-to-asset/docker", "chunk": 9, "priority": "low", "gpus": 8, "lost_after": 30.0,
            }  # fmt: skip
            submit(environment, "facescape-batch/batch-local", many, cwd=tmp_path)  # no worker takes it
            refused(environment, url, tmp_path, deployed["local"]["id"])
            bad = subprocess.run([PREFECT, "deployment", "run", "capture-to-asset/local", "--param", "capture=/nowhere",
                                  "--param", f"out={tmp_path / 'bad'}", "--watch"], env=environment, cwd=tmp_path,
                                 text=True, capture_output=True, timeout=PATIENCE)  # fmt: skip
        assert list(json.loads((out / "run.json").read_text())["stages"]) == ["capture"]
        runs = {r["state_type"]: r for r in ask(url, "/flow_runs/filter", {}, LOGIN) if "/etc" not in r["name"]}
        tasks = ask(url, "/task_runs/filter", {}, LOGIN)
        artifacts = {a["key"]: a for a in ask(url, "/artifacts/filter", {}, LOGIN)}
    assert set(runs) == {"COMPLETED", "FAILED", "SCHEDULED"}, (tmp_path / "worker.log").read_text()
    assert "/nowhere" in runs["FAILED"]["state"]["message"]
    assert set(good) == set(RunRequest.model_fields) and set(many) == set(BatchRequest.model_fields)
    assert runs["COMPLETED"]["parameters"] == good == json.loads((out / "run.json").read_text())["request"]
    assert runs["SCHEDULED"]["parameters"] == many == BatchRequest(**many).model_dump(mode="json")  # type: ignore[arg-type]
    assert bad.returncode != 0
    assert not (tmp_path / "bad").exists()
    assert [(t["name"], t["state_type"]) for t in tasks] == [("capture", "COMPLETED")]
    ends = ("local", "docker", "kubernetes")
    assert set(deployed) == {*ends, *(f"batch-{e}" for e in ends)}
    for name, deployment in deployed.items():
        steps = deployment["pull_steps"]  # no folder of the machine that deployed: others do not have it
        assert steps == [{"prefect.deployments.steps.set_working_directory": {"directory": "/tmp"}}]
        fields = deployment["parameter_openapi_schema"]["properties"]
        model = BatchRequest if name.startswith("batch-") else RunRequest
        assert list(fields) == list(model.model_fields)
        assert all(fields[n]["description"] == f.description for n, f in model.model_fields.items())
        defaults = {n: f.default for n, f in model.model_fields.items() if not f.is_required()}
        assert {n: f["default"] for n, f in fields.items() if "default" in f} == json.loads(json.dumps(defaults))
        assert fields["preset"]["default"] == "draft" and deployment["enforce_parameter_schema"]
    assert all(d["job_variables"] == {} for d in deployed.values())
    assert deployed["kubernetes"]["work_pool_name"] == "heads-kubernetes"
    assert artifacts["progress-capture"]["data"] == 100
    assert "| capture |" in artifacts["run"]["data"]
    assert str(out) in artifacts["run"]["data"]


def answers_no_stranger(url: str, login: str) -> None:
    """Neither a program without the login, nor a page of another origin, nor a forged request with the login."""
    for path, body, code in (("/deployments/filter", {}, 403), ("/csrf-token?client=t", None, 401),
                             ("/admin/settings", None, 401)):  # fmt: skip
        with pytest.raises(urllib.error.HTTPError) as e:
            ask(url, path, body)
        assert e.value.code == code, path
    for origin, allowed in (("http://evil.example", None), ("null", None), (url.removesuffix("/api"), "same")):
        preflight = {"Origin": origin, "Access-Control-Request-Method": "POST"}
        request = urllib.request.Request(f"{url}/deployments/filter", headers=preflight, method="OPTIONS")
        try:
            with urllib.request.urlopen(request) as answer:
                told = answer.headers.get("access-control-allow-origin")
        except urllib.error.HTTPError as refusal:
            told = refusal.headers.get("access-control-allow-origin")
        assert told == (origin if allowed else None), origin
    basic = {"Authorization": login_headers(url, login)["Authorization"], "Content-Type": "application/json"}
    with pytest.raises(urllib.error.HTTPError) as e:
        urllib.request.urlopen(urllib.request.Request(f"{url}/deployments/filter", b"{}", basic))
    assert e.value.code == 403


@pytest.mark.slow
def test_serve_starts_a_server_for_this_machine_alone_and_ends_it(
    tmp_path: Path, child_environment: dict[str, str]
) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    child_environment = {**child_environment, "PREFECT_HOME": str(tmp_path / "prefect")}  # no runs of other tests
    home = tmp_path / "home"
    command = [sys.executable, "-m", "workflows.cli", "serve", "--port", str(port), "--home", str(home), "--root",
               str(tmp_path / "tree"), "--root", str(tmp_path / "out")]  # fmt: skip
    with (tmp_path / "log").open("wb") as log:
        child = subprocess.Popen(command, env=child_environment, cwd=tmp_path, stdout=log, stderr=log,
                                 start_new_session=True)  # fmt: skip
    try:
        wait_healthy(url)
        login = (home / "login").read_text().strip()
        assert (home / "login").stat().st_mode & 0o777 == 0o600 and home.stat().st_mode & 0o777 == 0o700
        assert login not in (home / "server.log").read_text() and login not in (tmp_path / "log").read_text()
        wait_for(lambda: served(url, login, child) == 2, every=ASKED_EVERY)
        answers_no_stranger(url, login)
        sockets = [line.split() for f in ("tcp", "tcp6") for line in Path(f"/proc/net/{f}").read_text().splitlines()]
        listening = [s[1] for s in sockets if s[1].endswith(f":{port:04X}") and s[3] == "0A"]
        assert listening == [f"0100007F:{port:04X}"]
        entrypoints = {d["entrypoint"] for d in ask(url, "/deployments/filter", {}, login)}
        assert entrypoints == {"workflows.flows.capture_to_asset", "workflows.flows.facescape_batch"}
        write_tree(tmp_path / "tree", {"1/1_neutral": True})
        asked = {"root": str(tmp_path / "tree"), "out": str(tmp_path / "out"), "until": "capture", "gpus": 1}
        environment = {**child_environment, "PREFECT_API_URL": url, "PREFECT_API_AUTH_STRING": login}
        submit(environment, "facescape-batch/batch-local", asked, "--watch", cwd=tmp_path)
        counts = json.loads((tmp_path / "out/batch/summary.json").read_text())["counts"]
        assert counts["unusable"] == counts["done"] + counts["failed"] + 1 == 1  # three photos of noise
        runs = ask(url, "/flow_runs/filter", {}, login)
        assert [r["state_type"] for r in runs] == ["COMPLETED"] * 2, (tmp_path / "log").read_text()
        assert len([r for r in runs if (r["idempotency_key"] or "").startswith("neuface-")]) == 1
        os.kill(child.pid, signal.SIGINT)
        assert child.wait(60) == 0, (tmp_path / "log").read_text()
        with pytest.raises(OSError):
            ask(url, "/health")
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_the_server_of_serve_ends_with_it(
    tmp_path: Path, child_environment: dict[str, str], number: signal.Signals
) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    command = [sys.executable, "-m", "workflows.cli", "serve", "--port", str(port), "--home", str(tmp_path / "home")]
    environment = {**child_environment, "PREFECT_HOME": str(tmp_path / "prefect")}
    with (tmp_path / "log").open("wb") as log:
        child = subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=log, stderr=log,
                                 start_new_session=True)  # fmt: skip
    try:
        wait_healthy(url)
        login = (tmp_path / "home/login").read_text().strip()
        wait_for(lambda: served(url, login, child) == 2, every=ASKED_EVERY)
        servers = descendants(child.pid)
        child.send_signal(number)
        # 0 where Prefect's own handler was there already: it calls that a regular end
        allowed = (-9,) if number == signal.SIGKILL else (0, 128 + number)
        assert child.wait(240) in allowed, (tmp_path / "log").read_text()
        wait_for(lambda: not any(is_alive(s) for s in servers), 60)
        with pytest.raises(OSError):
            ask(url, "/health")
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        for written in (tmp_path / "log", tmp_path / "home/server.log"):  # shown where the test fails
            print(written.read_text() if written.is_file() else f"no {written}")


def served(url: str, login: str, child: subprocess.Popen[bytes]) -> int:
    """Deployments that the server of `neuface serve` knows; 0 while it does not answer."""
    assert child.poll() is None, "neuface serve ended"
    try:
        return len(ask(url, "/deployments/filter", {}, login))
    except urllib.error.HTTPError:
        raise
    except OSError as e:
        print(f"no answer: {e}")
        return 0


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
