"""A stage beside the chain: a person's measured expressions, from the registered heads of several captures.

Its inputs are named by the shapes, so that the key holds all of them, and the lineage every capture's photos.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import make_dataclass
from functools import partial
from typing import Any

import numpy as np

from pipeline.artifacts import CameraSet, Located
from pipeline.contract import Context, Stage, StageConfig
from pipeline.head_artifacts import MeasuredShapes, RegisteredHead
from workflows.batch.heads import Found
from workflows.store.gc import MEASURED

FILE = "measured.npz"
POSES = "poses_of_"  # before the name of an input: the cameras of that capture


def measured_stage(shapes: tuple[str, ...]) -> Stage[Any, Any, Any]:
    """The stage for expressions whose shapes have these names."""
    fields = [(n, Located[RegisteredHead]) for n in ("neutral", *shapes)]
    cameras = [(POSES + n, Located[CameraSet]) for n in ("neutral", *shapes)]
    inputs = make_dataclass("Inputs", [*fields, *cameras], frozen=True, slots=True)
    return Stage(MEASURED, 1, inputs, StageConfig, MeasuredShapes, partial(run, shapes), any_threads=True)


def inputs_of(stage: Stage[Any, Any, Any], neutral: Found, others: Mapping[str, Found]) -> Any:
    """The stage's inputs. others: by the name of the shape."""
    heads = {"neutral": neutral, **others}
    return stage.inputs(**{n: f.template for n, f in heads.items()}, **{POSES + n: f.poses for n, f in heads.items()})


def run(shapes: tuple[str, ...], inputs: Any, config: StageConfig, context: Context) -> MeasuredShapes:
    """Measure every expression on the neutral head. One that can't be used is left out with its reason."""
    from pipeline.registration.head import load_head
    from pipeline.registration.measured import measured
    from pipeline.registration.rig import load_rig
    from pipeline.registration.shapes import save_shapes, sparse
    from pipeline.transforms import scale_of

    own: Located[RegisteredHead] = inputs.neutral
    about = own.artifact
    assert about.head is not None and about.rig is not None, "the caller asks for both"
    neutral, rig = load_head(own.path(about.head)), load_rig(own.path(about.rig))
    unit, offsets = scale_of(np.asarray(about.world_from_template)), {}
    figures: dict[str, dict[str, float]] = {}
    left_out: dict[str, str] = {}
    for number, name in enumerate(shapes):
        context.check()
        context.progress(number, len(shapes), name)
        other: Located[RegisteredHead] = getattr(inputs, name)
        ref, metric = other.artifact.head, all(getattr(inputs, POSES + n).artifact.metric for n in ("neutral", name))
        assert ref is not None, "only registered heads are inputs"
        head = load_head(other.path(ref))
        if not np.array_equal(head.quads, neutral.quads):
            left_out[name] = f"its head template is {other.artifact.template}, the neutral's is {about.template}"
            continue
        made = measured(neutral, head, rig, about.regions, about.parts, unit, metric=metric)
        if made.refused:
            left_out[name] = made.refused
        else:
            offsets[name], figures[name] = made.offsets, made.figures
    if not offsets:
        return MeasuredShapes(left_out=left_out)
    save_shapes(context.workdir / FILE, sparse(tuple(offsets), list(offsets.values()), unit))
    return MeasuredShapes(file=context.file(FILE), shapes=figures, left_out=left_out)
