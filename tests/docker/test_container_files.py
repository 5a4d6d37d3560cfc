"""The container files without an engine: what they promise, and that they add up. docs/operations.md says what was
built and started."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml

from workflows.cli.main import parser
from workflows.server.access import CLIENT_LOGIN, ROOTS, SERVER_LOGIN

CLOSED = {"type": "object", "properties": {}, "additionalProperties": False}  # no variable, and none can be added

INSTRUCTIONS = {
    "ARG",
    "FROM",
    "ENV",
    "RUN",
    "WORKDIR",
    "COPY",
    "USER",
    "VOLUME",
    "CMD",
}  # no ENTRYPOINT: pools start theirs


@pytest.fixture(scope="module")
def compose(repo: Path) -> dict[str, Any]:
    read: dict[str, Any] = yaml.safe_load((repo / "docker/compose.yaml").read_text())
    return read


@pytest.fixture(scope="module")
def steps(repo: Path) -> list[tuple[str, str]]:
    """(instruction, its text), lines joined, comments gone."""
    text = re.sub(r"(?m)^\s*#.*\n", "", (repo / "docker/Dockerfile").read_text()).replace("\\\n", " ")
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in text.splitlines() if line.strip()]


def stages(steps: list[tuple[str, str]]) -> dict[str, list[tuple[str, str]]]:
    found: dict[str, list[tuple[str, str]]] = {}
    for word, text in steps:
        if word == "FROM":
            found[text.split(" AS ")[1]] = []
        if found:
            found[list(found)[-1]].append((word, text))
    return found


def test_only_known_instructions_and_shells_that_parse(steps: list[tuple[str, str]]) -> None:
    assert {word for word, _ in steps} <= INSTRUCTIONS
    for word, text in steps:
        if word == "RUN":
            assert shlex.split(text), text


def test_stages_build_on_what_is_there_and_on_a_pinned_base(steps: list[tuple[str, str]]) -> None:
    known = {"${BASE}"}
    for word, text in steps:
        if word == "FROM":
            assert text.split(" AS ")[0] in known
            known.add(text.split(" AS ")[1])
        if word == "COPY" and "--from=" in text:
            assert text.split()[0].removeprefix("--from=") in known
    assert {"build", "cpu", "gpu", "tests"} <= known
    base = next(text for word, text in steps if word == "ARG" and text.startswith("BASE="))
    assert re.fullmatch(r"BASE=python:3\.11\.\d+-slim-bookworm", base)


def test_what_is_copied_is_there(steps: list[tuple[str, str]], repo: Path) -> None:
    for word, text in steps:
        if word == "COPY" and "--from=" not in text:
            assert [p for p in text.split()[:-1] if not (repo / p).exists()] == []


def test_what_runs_has_no_root_no_compiler_and_no_package_manager_leftovers(steps: list[tuple[str, str]]) -> None:
    cpu = stages(steps)["cpu"]
    assert ("USER", "10001:10001") in cpu
    assert cpu.index(("USER", "10001:10001")) > max(i for i, (word, _) in enumerate(cpu) if word in ("RUN", "COPY"))
    installs = " ".join(text for word, text in cpu if word == "RUN")
    assert "gcc" not in installs and "pip" not in installs and "rm -rf /var/lib/apt/lists" in installs


@pytest.mark.skipif(shutil.which("hadolint") is None, reason="hadolint is not installed")
def test_the_linter_of_dockerfiles_has_nothing_to_say(repo: Path) -> None:
    done = subprocess.run(["hadolint", repo / "docker/Dockerfile"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.skipif(shutil.which("docker-compose") is None, reason="docker-compose is not installed")
def test_compose_reads_its_file_and_asks_for_the_password(repo: Path) -> None:
    command = ["docker-compose", "-f", repo / "docker/compose.yaml", "config"]
    environment = {k: v for k, v in os.environ.items() if k not in ("POSTGRES_PASSWORD", "PREFECT_LOGIN")}
    without = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert without.returncode != 0 and "set it in the environment" in without.stderr
    done = subprocess.run(
        command, env={**environment, "POSTGRES_PASSWORD": "x", "PREFECT_LOGIN": "a:b"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert set(yaml.safe_load(done.stdout)["services"]) == {"database", "server", "deploy", "worker", "batch-worker"}


@pytest.mark.skipif(shutil.which("jq") is None, reason="jq is not installed")
def test_a_job_of_a_cluster_mounts_what_prefect_yaml_says_and_has_no_root(repo: Path) -> None:
    container = {"name": "prefect-job"}
    asked = {"image": "{{ image }}", "args": "{{ command }}", "env": "{{ env }}"}
    spec = {"serviceAccountName": "{{ service_account_name }}", "containers": [{**container, **asked}]}
    manifest = {"metadata": {"generateName": "{{ name }}-"}, "spec": {"template": {"spec": spec}}}
    configuration = {"command": "{{ command }}", "env": "{{ env }}", "job_manifest": manifest}
    base = {"job_configuration": configuration, "variables": {"properties": {"command": {"type": "string"}}}}
    done = subprocess.run(["jq", "-f", repo / "docker/kubernetes-pool.jq"], input=json.dumps(base), check=True,
                          capture_output=True, text=True)  # fmt: skip
    pod = json.loads(done.stdout)["job_configuration"]["job_manifest"]["spec"]["template"]["spec"]
    made = pod["containers"][0]
    assert made.items() >= {**container, "image": "neuface:cpu"}.items()
    assert "{{" not in done.stdout and "command" not in done.stdout  # nothing that a run could fill in
    assert json.loads(done.stdout)["variables"] == CLOSED
    assert {m["name"]: m["mountPath"] for m in made["volumeMounts"]} == {
        "photos": "/photos",
        "runs": "/runs",
        "tmp": "/tmp",
    }
    assert {v["name"] for v in pod["volumes"]} == {"photos", "runs", "tmp"}
    assert pod["securityContext"]["runAsNonRoot"] and pod["securityContext"]["runAsUser"] == 10001
    assert made["securityContext"]["readOnlyRootFilesystem"] and not made["securityContext"]["allowPrivilegeEscalation"]


def test_no_run_in_a_pool_can_carry_a_command_or_an_environment(repo: Path) -> None:
    for path in (repo / "workflows/pools").glob("*.json"):
        template = json.loads(path.read_text())
        assert template["variables"] == CLOSED and "{{" not in path.read_text(), path.name
    deployments = yaml.safe_load((repo / "workflows/prefect.yaml").read_text())["deployments"]
    assert [d["name"] for d in deployments if "job_variables" in d["work_pool"]] == []
    for name in ("docs/operations.md", "docs/running.md", "docker/compose.yaml", "workflows/prefect.yaml"):
        for line in (repo / name).read_text().splitlines():
            if "work-pool create" in line:
                assert "--base-job-template" in line, f"{name}: {line}"


def test_a_server_that_is_documented_asks_for_a_login_and_answers_no_other_origin(
    compose: dict[str, Any], repo: Path
) -> None:
    server = compose["services"]["server"]["environment"]
    for name in ("deploy", "worker", "batch-worker"):
        assert compose["services"][name]["environment"][CLIENT_LOGIN] == "${PREFECT_LOGIN:?}", name
    assert server[SERVER_LOGIN].startswith("${PREFECT_LOGIN:?")
    options = parser().parse_args(compose["services"]["server"]["command"][1:])
    assert options.server_only and options.allow_host == ["127.0.0.1", "server"]
    assert compose["services"]["server"]["ports"] == ["127.0.0.1:4200:4200"]
    for name in ("worker", "batch-worker"):
        assert compose["services"][name]["environment"][ROOTS] == "/photos:/runs"
    text = (repo / "docs/operations.md").read_text()
    guide = text.partition("### Who may start what")[0]
    assert "neuface serve --server-only" in guide and "prefect server start" not in guide
    assert ROOTS in guide and CLIENT_LOGIN in guide


def test_a_restart_forgets_no_slot(compose: dict[str, Any]) -> None:
    server = compose["services"]["server"]
    assert server["command"][:3] == [
        "neuface",
        "serve",
        "--server-only",
    ]  # tests/workflows/test_guard.py: slots on disk
    home = server["environment"]["PREFECT_HOME"]
    assert home in [v.split(":")[1] for v in server["volumes"]] and not home.startswith("/tmp")


def test_every_service_is_pinned_hardened_and_watched(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        tag = service["image"].partition(":")[2]
        assert tag and tag != "latest", name
        assert service["read_only"] is True and service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert service["user"].split(":")[0] not in ("0", "root"), name
        assert "healthcheck" in service or service.get("restart") == "no", name


def test_services_wait_for_what_they_need(compose: dict[str, Any]) -> None:
    services = compose["services"]
    for name, service in services.items():
        for other, how in service.get("depends_on", {}).items():
            assert how["condition"] != "service_healthy" or "healthcheck" in services[other], (name, other)
            assert how["condition"] != "service_completed_successfully" or services[other]["restart"] == "no"
    for name, service in services.items():
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            assert source.startswith("..") or source in compose["volumes"], (name, volume)


def test_no_secret_is_written_down(repo: Path) -> None:
    for name in ("compose.yaml", "Dockerfile"):
        text = (repo / "docker" / name).read_text()
        for line in text.splitlines():
            value = re.search(r"(?i)(password|secret|token)\w*[:=]\s*(\S+)", line)
            allowed = value is None or line.lstrip().startswith("#") or value[2].startswith(("${", "?"))
            assert allowed, line


def test_compose_and_the_documented_commands_deploy_what_prefect_yaml_has(compose: dict[str, Any], repo: Path) -> None:
    deployed = yaml.safe_load((repo / "workflows/prefect.yaml").read_text())["deployments"]
    names = {(d["entrypoint"], d["name"]): d["work_pool"]["name"] for d in deployed}
    command = compose["services"]["deploy"]["command"][2]
    local = {n for _, n in names if n.endswith("local")}
    assert set(re.findall(r"-n (\S+)", command)) == local  # by name: Prefect's `*local` does not match `local`
    assert [pool for (_, n), pool in names.items() if n in local and f"work-pool create {pool} " not in command] == []
    for service, flow, name in (
        ("worker", "capture_to_asset", "local"),
        ("batch-worker", "facescape_batch", "batch-local"),
    ):
        assert compose["services"][service]["command"][4] == names[f"workflows.flows.{flow}", name]
    lines = [x for x in (repo / "docs/operations.md").read_text().splitlines() if "prefect --no-prompt deploy" in x]
    told = [set(re.findall(r"-n (\S+)", line)) for line in lines]
    assert sorted(n for names in told for n in names) == sorted(n for _, n in names) and len(names) == 6


def test_the_server_has_its_page_though_its_root_is_read_only(compose: dict[str, Any]) -> None:
    place = compose["services"]["server"]["environment"]["PREFECT_SERVER_UI_STATIC_DIRECTORY"]
    assert place.startswith("/tmp/")
