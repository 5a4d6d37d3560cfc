"""A batch whose runs leave finished artifacts of heads that are known, without any work of the stages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.artifacts import Artifact, CameraSet, FileRef, TextureMap, TextureSet, UvMesh
from pipeline.asset_artifacts import UsdAsset
from pipeline.contract import Context
from pipeline.head_artifacts import RegisteredHead
from pipeline.images import write_exr
from pipeline.store import Store
from tests.support.persons import SHIFT, SMILE, TURN, expression, head, names, person, rig, template
from tests.support.scripted_batch import Scripted
from workflows.batch.failures import Failure
from workflows.batch.loop import Ended
from workflows.batch.state import Entry
from workflows.run.request import RunRequest
from workflows.store.roots import note_root

SIZE = 64
STILL = tuple(tuple(float(x) for x in row) for row in np.eye(4))
SHARES = {"2_smile": SMILE, "3_mouth_stretch": {"jawOpen": 0.5}, "16_grin": {"mouthSmileLeft": 1.0}}
NEUTRAL = "1_neutral"


def face_tree(folder: Path, captures: tuple[str, ...]) -> Path:
    """A tree in FaceScape's layout with files that no stage reads."""
    root = folder / "faces"
    for name in captures:
        (root / name).mkdir(parents=True)
        (root / name / "params.json").write_text("{}")
        (root / name / "0.jpg").write_bytes(name.encode())
    return root


@dataclass
class Faked(Scripted):
    """A Runner whose runs leave what the stages template, uv, bake and usd would: the head of subject N is person N,
    its expression that of the folder's name. unregistered, unseen: captures without a head, or whose photos show
    nothing. levels: verdicts."""

    out: Path
    store: Path
    script: dict[str, list[Failure | None]] = field(default_factory=dict)
    levels: Any = field(default_factory=dict)
    unregistered: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    batch: int = 4096

    def __post_init__(self) -> None:
        super().__init__(self.out, self.script, self.batch, self.levels)
        self.requests: dict[str, RunRequest] = {}

    def start(self, entry: Entry, request: RunRequest) -> None:
        super().start(entry, request)
        self.requests[entry.name] = request

    def kill(self) -> None:
        """Nothing is under way."""

    def poll(self) -> list[Ended]:
        ended = list(super().poll())
        for e in ended:
            if e.fault is None:
                self.finish(self.requests[e.name], e.name)
        return ended

    def finish(self, request: RunRequest, name: str) -> None:
        """The artifacts of a run in the store, and its run.json."""
        store, out = Store(self.store), Path(request.out)
        photos = Path(request.capture)
        keys, folders = {}, {"source": photos}
        for stage, made in self.artifacts(name).items():
            key = _key(f"{stage} {name}")
            keys[stage] = key
            _put(store, stage, key, made, folders)
            folders = {stage: store.folder(stage, key)}
        named = [s.partition("=")[2] for s in request.sets if s.startswith("usd.measured=")]
        keys["usd"] = _key(f"usd {name} {named}")
        behind = folders | ({"measured": Path(named[0]).parent} if named else {})
        _put(store, "usd", keys["usd"], lambda folder: UsdAsset(name="head", root="a.usd", files=(), checks=0), behind)
        record = {
            "stages": {s: {"key": k} for s, k in keys.items()}, "store": str(store.root), "timing": {},
            "request": {"capture": str(photos), "sets": list(request.sets)},
        }  # fmt: skip
        (out / "asset").mkdir(parents=True, exist_ok=True)
        (out / "asset" / "head.usd").write_text(" ".join(named))
        (out / "run.json").write_text(json.dumps(record))
        note_root(store, out, keys)

    def artifacts(self, name: str) -> Mapping[str, Any]:
        """By stage, what writes its files into a folder and returns its manifest."""
        subject, _, called = name.partition("/")
        moved = called != NEUTRAL
        vertices = person(int(subject)) + expression(SHARES.get(called, {}))
        pose = {"turn": TURN, "shift": SHIFT} if moved else {}
        made = head(vertices, 0.0 if name in self.unseen else 1.0, **pose)
        regions, parts = names()
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = pose.get("turn", np.eye(3)), pose.get("shift", np.zeros(3))

        def registered(folder: Path) -> RegisteredHead:
            if name in self.unregistered:
                return RegisteredHead(registered=False, reason="no face was found in three photos or more")
            made.save(folder / "head.npz")
            rig().save(folder / "rig.npz")
            return RegisteredHead(
                registered=True, head=FileRef.of(folder, "head.npz"), rig=FileRef.of(folder, "rig.npz"),
                template=template().name, regions=regions, parts=parts, quads=len(made.quads),
                world_from_template=tuple(tuple(float(x) for x in row) for row in world),
            )  # fmt: skip

        return {
            "poses": lambda folder: CameraSet(
                source="given", metric=True, capture_from_asset=STILL, roi_radius=0.15, cameras=()
            ),
            "template": registered,
            "uv": lambda folder: _mesh(folder, of_template=name not in self.unregistered),
            "bake": lambda folder: _maps(folder, int(subject)),
        }


def _mesh(folder: Path, *, of_template: bool) -> UvMesh:
    (folder / "mesh.npz").write_bytes(b"none")
    figures = {"vertices": 1, "faces": 1, "charts": 1, "utilisation": 0.5, "stretch": 1.0, "overlap": 0.0}
    return UvMesh(mesh=FileRef.of(folder, "mesh.npz"), of_template=of_template, deviation_mm=0.0, **figures)  # type: ignore[arg-type]


def _maps(folder: Path, seed: int) -> TextureSet:
    """Stripes of 8 texels, the same on everybody, in the person's own brightness."""
    stripes = 0.3 + 0.05 * seed + 0.1 * np.sign(np.sin(2 * np.pi * np.arange(SIZE) / 8))
    albedo = np.repeat(np.repeat(stripes[None, :, None], SIZE, 0), 3, 2).astype(np.float32)
    maps = {}
    for name, picture in (("albedo", albedo), ("confidence", np.ones((SIZE, SIZE, 1), np.float32))):
        files = {}
        for tile in (1001, 1002):
            write_exr(folder / f"{name}.{tile}.exr", picture)
            files[f"{tile}.exr"] = FileRef.of(folder, f"{name}.{tile}.exr")
        about = {"minimum": 0.0, "mean": 0.5, "maximum": 1.0}
        maps[name] = TextureMap(name=name, channels=picture.shape[2], files=files, space="srgb_png", **about)  # type: ignore[arg-type]
    return TextureSet(size=SIZE, tiles=2, padding=SIZE, maps=maps, coverage=0.5)


def _put(store: Store, stage: str, key: str, make: Any, folders: Mapping[str, Path]) -> None:
    with store.lock(stage, key):
        store.trace(stage, key, folders)
        if not store.folder(stage, key).is_dir():
            partial = store.begin(stage, key)
            made: Artifact = make(Context(partial, partial).workdir)
            store.finish(stage, key, partial, made, {"seconds": 1.0})


def _key(text: str) -> str:
    import hashlib

    return hashlib.sha256(text.encode()).hexdigest()
