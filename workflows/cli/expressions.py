"""`neuface expressions`: an OBJ for each expression of an asset, for tools that read neither USD nor glTF shapes.

All files have the same vertices in the same order, the same quads and the same texture coordinates, so that a tool
takes them as one sequence, or as targets of one base.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stages.presets import known
from workflows.cli.render import component_in, put_file
from workflows.run.output_dirs import make_folder

if TYPE_CHECKING:
    from pipeline.meshes import F64
    from stages.usd.render.expressions import ControlCage

NEUTRAL = "neutral"


@dataclass(frozen=True, slots=True)
class ExpressionsRequest:
    """The options of the command. only: names of expressions; none: all."""

    folder: Path
    out: Path
    only: tuple[str, ...] = ()


def write_expressions(request: ExpressionsRequest, notify: Callable[[str], None]) -> Iterator[Path]:
    """Write and yield NAME_00_neutral.obj, NAME_01_eyeBlinkLeft.obj, ...: numbered in the asset's order.

    A file of the user's own of such a name is kept aside, and `notify` is called.

    Raises:
        StageError: the asset has no expressions. UsageError: it has none of this name.
    """
    from stages.usd.render.expressions import load_cage

    root = component_in(request.folder)
    cage = load_cage(root)
    for name in request.only:
        known(name, cage.shapes, what="no such expression", where="--only")
    make_folder(request.out)
    faces = "\n".join(_faces(cage))
    for number, name in enumerate((NEUTRAL, *cage.shapes)):
        if name != NEUTRAL and request.only and name not in request.only:
            continue
        points = cage.points if name == NEUTRAL else cage.under(name)
        text = "\n".join([f"# {name}: control cage, metres, +Y up", f"o {root.stem}", *_positions(points)])
        file = f"{root.stem}_{number:02d}_{name}.obj"
        put_file(request.out, file, _write, f"{text}\n{faces}\n", notify)
        yield request.out / file


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="ascii")


def _positions(points: F64) -> Iterator[str]:
    return (f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in points.tolist())


def _faces(cage: ControlCage) -> Iterator[str]:
    """Texture coordinates and faces; indices start at 1."""
    yield from (f"vt {u:.7g} {v:.7g}" for u, v in cage.uvs.tolist())
    corners = [f"{a}/{t}" for a, t in zip((cage.corners + 1).tolist(), (cage.uv_corners + 1).tolist(), strict=True)]
    end = 0
    for count in cage.faces.tolist():
        yield "f " + " ".join(corners[end : end + count])
        end += count
