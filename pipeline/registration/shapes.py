"""The file of measured expressions, and how its shapes come into a rig.

An npz: names (E,) that begin with PREFIX; starts (E + 1,), vertices (n,), offsets (n, 3) as in
pipeline.template.model.Expressions, in the unit of the head that they are for.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.errors import StageError
from pipeline.meshes import F64
from pipeline.registration.expressions import LEAST
from pipeline.registration.rig import Rig
from pipeline.template.files import read_arrays
from pipeline.template.model import Expressions

PREFIX = "measured_"  # of the names of the blend shapes
LARGEST = 1.0  # metres: no expression moves a vertex as far
LONGEST = 200  # letters of a name


def sparse(names: tuple[str, ...], offsets: list[F64], unit: float) -> Expressions:
    """The shapes of these names from offsets (V, 3) each, without what does not move. unit: world units per metre of
    the template."""
    rows = [np.flatnonzero(np.linalg.norm(o, axis=1) > LEAST * unit) for o in offsets]
    starts = np.cumsum([0, *(len(r) for r in rows)])
    moved = [o[r] for o, r in zip(offsets, rows, strict=True)]
    none = np.zeros(0, np.int64)
    return Expressions(
        names, starts.astype(np.int64), np.concatenate([none, *rows]).astype(np.int64),
        np.concatenate([np.zeros((0, 3)), *moved]),
    )  # fmt: skip


def save_shapes(path: Path, shapes: Expressions) -> None:
    """Write the npz."""
    np.savez(
        path, names=np.array(shapes.names, np.str_), starts=shapes.starts, vertices=shapes.vertices.astype(np.int32),
        offsets=shapes.offsets.astype(np.float32),
    )  # fmt: skip


def load_shapes(path: Path) -> Expressions:
    """The shapes of an npz that `save_shapes` wrote.

    Raises:
        StageError: it is none.
    """
    try:
        z = read_arrays(path)
        names = tuple(str(n) for n in np.atleast_1d(z["names"]))
        with np.errstate(invalid="ignore"):
            starts, rows = (np.asarray(z[n]).astype(np.int64) for n in ("starts", "vertices"))
            found = Expressions(names, starts, rows, np.asarray(z["offsets"]).astype(np.float64))
    except StageError as e:
        raise _no_shapes(path, str(e.value)) from e
    except (ValueError, KeyError, TypeError, OverflowError) as e:
        raise _no_shapes(path, f"{type(e).__name__}: {e}") from e
    fault = _fault(found)
    if fault:
        raise _no_shapes(path, fault)
    return found


def with_shapes(rig: Rig, shapes: Expressions, path: Path) -> Rig:
    """The rig with further shapes after its own. path: their file, for the error.

    Raises:
        StageError: they are of another topology, or have a name that the rig has.
    """
    own = rig.expressions
    twice = set(own.names) & set(shapes.names)
    if twice:
        raise _no_shapes(path, f"a second shape {min(twice)}")
    if len(shapes.vertices) and shapes.vertices.max() >= len(rig.weights):
        raise _no_shapes(path, f"vertex {shapes.vertices.max()} of {len(rig.weights)}")
    return replace(rig, expressions=Expressions(
        own.names + shapes.names, np.concatenate([own.starts, own.starts[-1] + shapes.starts[1:]]),
        np.concatenate([own.vertices, shapes.vertices]), np.concatenate([own.offsets, shapes.offsets]),
    ))  # fmt: skip


def _fault(e: Expressions) -> str:
    count = e.vertices.size
    if (
        e.starts.shape != (len(e.names) + 1,)
        or e.starts[0] != 0
        or e.starts[-1] != count
        or (np.diff(e.starts) < 0).any()
    ):
        return "rows that do not belong to the names"
    if e.vertices.shape != (count,) or e.offsets.shape != (count, 3) or not (np.abs(e.offsets) < LARGEST).all():
        return f"offsets that are not three numbers below {LARGEST:g} a vertex"
    if count and e.vertices.min() < 0:
        return f"vertex {e.vertices.min()}"
    names = set(e.names)
    if len(names) != len(e.names) or not all(map(_is_name, names)):
        return f"names other than {PREFIX}NAME, or one name twice"
    return ""


def _is_name(name: str) -> bool:
    return name.startswith(PREFIX) and name.isidentifier() and name.isascii() and len(name) <= LONGEST


def _no_shapes(path: Path, value: str) -> StageError:
    return StageError(
        "these are no measured expressions of this head",
        where=path,
        value=value,
        limit="a file that neuface batch --neutral wrote for it",
        remedy="run neuface batch --neutral again, or leave usd.measured out",
    )
