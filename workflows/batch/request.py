"""One batch, as plain data: the same from the command line and from the deployment's form."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from stages.presets import DEFAULT_PRESET, parse_sets
from workflows.run.request import RunRequest

PRIORITIES = ("high", "normal", "low")
DEPLOYMENT = "capture-to-asset/local"

# `prefect deployment run --param neutral=1` sends a number.
NameOrNumber = Annotated[
    str,
    BeforeValidator(lambda v: str(v) if isinstance(v, int) and not isinstance(v, bool) else v),
    WithJsonSchema({"anyOf": [{"type": "string"}, {"type": "integer"}]}),
]


class BatchRequest(BaseModel):
    """Captures, what to do with each, and how hard to try."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    root: str = Field(min_length=1, description="FaceScape tree (ID/EXPRESSION/params.json), or a .csv or .json list")
    out: str = Field(min_length=1, description="folder for the results: a folder for each capture, batch/index.html")
    subjects: str | None = Field(None, description="only these: 1-40 or 1,7,20-29; all by default")
    expressions: str | None = Field(None, description="only these numbers: 1,2; all by default")
    neutral: NameOrNumber | None = Field(
        None,
        description="number or name of the neutral expression (1): each person's others become measured blend shapes "
        "of its asset; needs uv.mesh=template, which is then the default",
    )
    average: bool = Field(
        False,
        description="also write OUT/average: the average head and texture of all captures (with --neutral: of the "
        "neutrals); needs uv.mesh=template, which is then the default",
    )
    preset: str = Field(DEFAULT_PRESET, description="speed against accuracy: draft, studio, film; or paper")
    holdout: str | None = Field(
        None, description="views that are not fitted but used for the metrics, as in neuface run; none by default"
    )
    seed: int = Field(0, ge=0, description="seed of every random draw")
    template: str | None = Field(
        None, description="folder of another head template, from which the assets are made, as in neuface run"
    )
    device: str = Field("auto", description="where the fit runs: auto, cpu or cuda")
    until: str | None = Field(None, description="last stage to run")
    sets: tuple[str, ...] = Field((), description="one setting, stage.key=value; repeatable")
    config: dict[str, dict[str, Any]] = Field({}, description="settings by stage, then by key")
    store: str | None = Field(None, description="folder of finished stages; OUT/.store by default")
    stage_limit: float | None = Field(6 * 3600.0, gt=0, description="time that one stage may take")
    force: bool = Field(False, description="go on to the fit although the photos, cameras or masks are unusable")
    strict: bool = Field(False, description="results that are only usable also count as refused: exit code 3")
    pack: Literal["zip"] | None = Field(None, description="also write a zip of each asset, as in neuface run")
    attempts: int = Field(3, ge=1, le=20, description="attempts at a capture whose failure may pass")
    deployment: str = Field(DEPLOYMENT, description="flow/name of the deployment that runs one capture")
    chunk: int = Field(50, ge=1, le=200, description="runs on the server at a time that are not finished")
    priority: Literal["high", "normal", "low"] | None = Field(
        None, description="work queue of the pool; made if it is not there. None: the deployment's own"
    )
    gpus: int | None = Field(None, ge=1, description="fits at a time in the whole pool; no limit by default")
    lost_after: float = Field(60.0, ge=1, description="time without a living process after which a run is lost")

    @property
    def store_path(self) -> Path:
        """Where finished stages of all captures are kept."""
        return Path(self.store).absolute() if self.store else Path(self.out).absolute() / ".store"

    @property
    def folder(self) -> Path:
        """The batch's own records: captures/*.json, logs/, index.html, summary.json, summary.csv."""
        return Path(self.out).absolute() / "batch"

    @property
    def fit_slots(self) -> str | None:
        """Name of the global concurrency limit that holds `gpus` slots."""
        return None if self.gpus is None else "neuface-fits"

    def run_request(self, capture: Path, name: str, sets: tuple[str, ...], own: dict[str, Any]) -> RunRequest:
        """One capture's run. `own`: settings of this capture from a list; `sets`: what earlier attempts changed."""
        of_all = {
            "preset",
            "holdout",
            "template",
            "seed",
            "device",
            "until",
            "config",
            "stage_limit",
            "force",
            "strict",
            "pack",
        }
        shared = self.model_dump(include=of_all)
        if (self.neutral is not None or self.average) and not self._names_the_mesh():
            shared["config"] = {**self.config, "uv": {**self.config.get("uv", {}), "mesh": "template"}}
        return RunRequest(
            **{**shared, **own},
            capture=str(capture),
            out=str(Path(self.out).absolute() / name),
            name=asset_name(name),
            sets=self.sets + sets,
            store=str(self.store_path),
            fit_slots=self.fit_slots,
        )

    def _names_the_mesh(self) -> bool:
        """Whether a setting says what the asset is made of."""
        return "mesh" in self.config.get("uv", {}) or "mesh" in parse_sets(self.sets).get("uv", {})


def asset_name(name: str) -> str:
    """A name that USD takes, from the capture's: "12/3_mouth" -> "head_12_3_mouth"."""
    from stages.usd.naming import name_from

    return name_from(f"head_{name}")
