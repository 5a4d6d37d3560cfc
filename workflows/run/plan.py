"""The plan of a run, checked before anything is written. The same request makes the same plan everywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.artifacts import Artifact, Located
from pipeline.contract import Stage, StageConfig, inputs_from, key
from pipeline.errors import StageError, UsageError
from pipeline.store import MANIFEST, Store
from stages import registry
from stages.presets import DEFAULT_PRESET, Settings, configs_for, known, parse_sets
from stages.registry import FIT
from workflows.run.published import FOLDERS
from workflows.run.request import RunRequest
from workflows.run.room import check_addresses

DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True, slots=True)
class Plan:
    """The stages to run, in order, with their settings. `anew`: those that run even if the store has them."""

    request: RunRequest
    source: Located[Any]
    out: Path
    store: Store
    stages: tuple[Stage[Any, Any, Any], ...]
    configs: dict[str, StageConfig]
    device: str
    anew: frozenset[str]
    also: Located[Any] | None = None  # what the folder of the second capture holds

    @property
    def sources(self) -> dict[str, Located[Artifact]]:
        """What the stages begin with, by the names of their inputs."""
        out: dict[str, Located[Artifact]] = {registry.SOURCE: self.source}
        return out if self.also is None else {**out, registry.ALSO + registry.SOURCE: self.also}


def make_plan(request: RunRequest) -> Plan:
    """Check a request and read what the capture's folder holds. Nothing is written.

    Raises:
        UsageError: unknown names, or settings outside their limits.
        StageError: the capture can't be used, or the device is not there.
    """
    from stages.capture.scan import scan_capture

    check_addresses()
    chosen, anew = _choose(request)
    configs = check_settings(request)
    _check_template(configs)
    _check_light(configs)
    _check_paint(configs)
    _names_a_folder(request.out, "--out")
    capture, out = Path(request.capture).absolute(), Path(request.out).absolute()
    source = scan_capture(capture)
    also = None if request.also is None else _second(request.also, capture, scan_capture)
    if out.resolve() == capture.resolve():
        raise UsageError(
            "the results would land among the photos",
            where="--out",
            value=out,
            limit="another folder than the capture's",
            remedy=f"for example --out {out / 'asset_run'}",
        )
    store = Store(request.store_path)
    _apart(store.root, capture, out)
    needs_torch = any(s.name == FIT for s in chosen)
    device = device_for(request.device) if needs_torch else "cpu"
    if device == "cuda":
        configs = of_gpu(request, configs)
    return Plan(
        request,
        source,
        out,
        store,
        chosen,
        configs,
        device,
        anew,
        also,
    )


def check_settings(request: RunRequest, planned: Settings | None = None) -> dict[str, StageConfig]:
    """The settings of every stage that a request makes, whatever its capture holds. planned: what its budget pays for.

    Raises:
        UsageError: unknown names, or settings outside their limits.
    """
    _choose(request)
    if request.budget is not None and request.preset != DEFAULT_PRESET:
        raise UsageError(
            "a budget and a preset both set the size of the fit",
            where="--budget and --preset",
            value=request.preset,
            limit="one of the two",
            remedy="leave --preset out, or the budget",
        )
    known(request.device, DEVICES, what="unknown device", where="--device")
    found = configs_for(
        request.preset,
        parse_sets(request.sets),
        request.config,
        holdout=request.holdout,
        name=request.name,
        seed=request.seed,
        template=request.template,
        light=request.light,
        registry=registry.REGISTRY if request.also is None else (*registry.REGISTRY, registry.EVERY[-1]),
        planned=planned,
    )
    if request.also is None:
        return found
    of_second = {s.name: found[s.name.removeprefix(registry.ALSO)] for s in registry.with_second()}
    return found | of_second


def of_gpu(request: RunRequest, configs: dict[str, StageConfig]) -> dict[str, StageConfig]:
    """The settings with a GPU's batch, unless it is given: a GPU waits for the start of its operations, and the larger
    batch takes no longer. The systems that the paper compares keep theirs."""
    from stages.inverse_rendering.config import GPU_BATCH, Config

    fit = configs.get(FIT)
    if not isinstance(fit, Config) or fit.preset not in Config.presets or fit.batch >= GPU_BATCH:
        return configs
    return check_settings(request, {FIT: {"batch": GPU_BATCH}})


def _check_template(configs: dict[str, StageConfig]) -> None:
    """Read another head template before anything runs. StageError says what is wrong with it."""
    folder = getattr(configs.get("template"), "folder", "")
    if folder:
        from pipeline.template.load import load_template

        load_template(Path(folder))


def _check_light(configs: dict[str, StageConfig]) -> None:
    """Read a given light before anything runs. StageError says what is wrong with it."""
    path = getattr(configs.get(FIT), "light_file", "")
    if path:
        from pipeline.lighting.given import read_latlong

        read_latlong(Path(path))


def _check_paint(configs: dict[str, StageConfig]) -> None:
    """Read painted masks before anything runs. StageError says what is wrong with them."""
    folder = getattr(configs.get("reflectance"), "paint", "")
    if folder:
        from stages.reflectance.paint import read_masks

        read_masks(Path(folder))


def _second(named: str, first: Path, scan: Callable[[Path], Located[Any]]) -> Located[Any]:
    """What the second capture's folder holds."""
    _names_a_folder(named, "--also")
    folder = Path(named).absolute()
    if folder.resolve() == first.resolve():
        raise UsageError(
            "the second capture is the first",
            where="--also",
            value=folder,
            limit="another folder than the capture's",
            remedy="name a capture of the same subject under another light, or leave --also out",
        )
    return scan(folder)


def _choose(request: RunRequest) -> tuple[tuple[Stage[Any, Any, Any], ...], frozenset[str]]:
    until, from_stage = request.until, request.from_stage
    every = registry.REGISTRY if request.also is None else registry.with_second()
    names = [s.name for s in every]
    for option, value in (("--until", until), ("--from-stage", from_stage)):
        if value is not None:
            known(value, names, what="unknown stage", where=option)
    last = names.index(until) if until else len(names) - 1
    first = names.index(from_stage) if from_stage else len(names)
    if from_stage and first > last:
        raise UsageError(
            "nothing would run",
            where="--from-stage and --until",
            value=f"{from_stage} after {until}",
            limit="a first stage that is not after the last",
            remedy="swap them, or leave one out",
        )
    return tuple(every[: last + 1]), frozenset(names[first : last + 1])


def _apart(store: Path, capture: Path, out: Path) -> None:
    """Raises UsageError for a store among the photos or in a folder that results replace."""
    root = store.resolve()
    inside = [f for f in (out / name for name in FOLDERS) if root.is_relative_to(f.resolve())]
    if root == capture.resolve() or inside:
        raise UsageError(
            "finished stages would land among other files",
            where="--store",
            value=store,
            limit=f"another folder than the capture's, and none in {out / FOLDERS[0]} or {out / FOLDERS[1]}",
            remedy=f"leave --store out (it is then {out / '.store'}), or name a folder of its own",
        )


def _names_a_folder(text: str, option: str) -> None:
    if not text.strip():
        raise UsageError("no folder is named", where=option, value=repr(text), limit="a path", remedy="name a folder")


def device_for(wanted: str) -> str:
    """The device that "auto" means here, or the wanted one if it is there."""
    if wanted == "cpu" or (wanted == "auto" and _without_cuda()):
        return "cpu"
    import torch

    if torch.cuda.is_available():
        return "cuda" if wanted == "cuda" or _has_kernels() else "cpu"
    if wanted == "cuda":
        raise StageError(
            "there is no CUDA device that torch can use",
            where="--device",
            value="cuda",
            limit=f"a build of torch with CUDA and a GPU (this is torch {torch.__version__})",
            remedy="run with --device cpu, or install a CUDA build of torch",
        )
    return "cpu"


def _without_cuda() -> bool:
    """Whether the installed torch is a build for the CPU alone: its version says so, without loading it (a second)."""
    try:
        return version("torch").endswith("+cpu")
    except PackageNotFoundError:  # a torch that no package manager knows of
        return False


def _has_kernels() -> bool:
    """Whether the fit's GPU kernels can be compiled here: without them the processor is faster."""
    from pipeline.maths import cuda_kernels

    return cuda_kernels.available()


@dataclass(frozen=True, slots=True)
class Step:
    """What would happen to one stage: "reused", "made", or "made anew". `key` is None where it is not known yet."""

    stage: str
    key: str | None
    action: str


def preview(plan: Plan) -> list[Step]:
    """What `run` would do, from the manifests in the store; nothing is run, hashed or written."""
    finished = plan.sources
    steps: list[Step] = []
    for stage in plan.stages:
        unplanned = plan.request.budget is not None and stage.name == FIT  # its settings depend on the hour
        if unplanned or not all(f in finished for f in stage.inputs.__dataclass_fields__):
            steps.append(Step(stage.name, None, "made"))
            continue
        k = key(stage, inputs_from(stage, finished), plan.configs[stage.name])
        manifest = plan.store.folder(stage.name, k) / MANIFEST
        found = _stored(plan.store, stage, k) if stage.name not in plan.anew else None
        if found is None:
            steps.append(Step(stage.name, k, "made anew" if manifest.is_file() else "made"))
            continue
        finished[stage.name] = found
        steps.append(Step(stage.name, k, "reused"))
    return steps


def _stored(store: Store, stage: Stage[Any, Any, Any], k: str) -> Located[Artifact] | None:
    """What the store has of a key; None if it has nothing, or its manifest is damaged."""
    try:
        return Located(store.manifest(stage.name, k, stage.output), store.folder(stage.name, k))
    except (OSError, ValidationError):
        return None
