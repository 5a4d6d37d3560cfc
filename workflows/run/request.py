"""What a user asks for: one run, as plain data. The command line, a deployment's form and run.json all use it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from stages.presets import DEFAULT_PRESET

OWN_STORE = ".store"  # in OUT, where none is named
Seconds = Annotated[float, Field(gt=0)]


class RunRequest(BaseModel):
    """One run. The options of `neuface run` (workflows/cli/options.py) and the form of the deployment
    (workflows/server/flow_signature.py) are made of these fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    capture: str = Field(description="folder with the photos, or a FaceScape capture")
    out: str = Field(description="folder for the results; created if missing")
    preset: str = Field(default=DEFAULT_PRESET, description="speed against accuracy: draft, studio, film; or paper")
    holdout: str | None = Field(
        default=None,
        description="views that are not fitted but used for the metrics: every:5:2 (index % 5 == 2) or "
        "names:a.jpg,b.jpg; none by default",
    )
    name: str | None = Field(default=None, description="name of the asset")
    seed: int = Field(default=0, description="seed of every random draw")
    template: str | None = Field(
        default=None,
        description="folder of another head template (docs/template.md); the asset is made from it, unless uv.mesh "
        "says otherwise",
    )
    light: str | None = Field(
        default=None,
        description="lat-long .exr or .hdr of the photos' light, measured: it is not estimated (docs/captures.md)",
    )
    also: str | None = Field(
        default=None,
        description="folder of a second capture of the same subject, in the same pose, under another light: both are "
        "fitted together (docs/stages/together.md)",
    )
    device: str = Field(default="auto", description="where the fit runs: auto, cpu or cuda")
    until: str | None = Field(default=None, description="last stage to run")
    from_stage: str | None = Field(
        default=None, description="run this stage and those after it again, even if the store has their results"
    )
    sets: tuple[str, ...] = Field(default=(), description="one setting, stage.key=value; repeatable")
    config: dict[str, dict[str, Any]] = Field(default={}, description="settings by stage, then by key")
    store: str | None = Field(default=None, description="folder of finished stages; OUT/.store by default")
    budget: Seconds | None = Field(
        default=None, description="time for the whole run, in place of a preset: the fit is sized on this machine"
    )
    stage_limit: Seconds | None = Field(default=None, description="time that one stage may take; no limit by default")
    fit_slots: str | None = Field(
        default=None, description="name of a global concurrency limit; the fit holds one of its slots (a GPU, say)"
    )
    force: bool = Field(
        default=False, description="go on to the fit although the photos, cameras or masks are unusable"
    )
    pack: Literal["zip"] | None = Field(
        default=None, description="also write OUT/NAME.zip with what other programs import of the asset"
    )
    no_exr_views: bool = Field(
        default=False, description="no EXR pictures of the held-out views in OUT/report, only PNG; the store has them"
    )
    keep_all: bool = Field(
        default=False,
        description="keep the report's page in OUT/.store as well: by default it is in OUT alone, and comes back from "
        "there when it is needed",
    )
    no_live: bool = Field(default=False, description="tell `neuface view` nothing while the run goes on")
    strict: bool = Field(default=False, description="a result that is only usable also counts as refused: exit code 3")

    @property
    def store_path(self) -> Path:
        """Where finished artifacts are kept."""
        return Path(self.store) if self.store else Path(self.out) / OWN_STORE

    def whole_paths(self) -> dict[str, str]:
        """The user's own folders and files as absolute paths: later commands have other working folders."""
        named = {n: getattr(self, n) for n in ("capture", "also", "template", "light")}
        return {n: str(Path(text).absolute()) for n, text in named.items() if text}
