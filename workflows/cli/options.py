"""Options of a command from the fields of its request, and the request from the options.

The request's model (workflows/run/request.py, workflows/batch/request.py) is the only place for names, defaults, limits
and descriptions; here is what only a command line needs: times such as 90s, files of settings, $NEUFACE_STORE.
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from pipeline.errors import UsageError
from stages.presets import read_config_file

M = TypeVar("M", bound=BaseModel)

UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
TIMES = ("budget", "stage_limit", "lost_after")
METAVARS = {
    "out": "DIR",
    "store": "DIR",
    "holdout": "RULE",
    "template": "DIR",
    "light": "FILE",
    "also": "DIR",
    "until": "STAGE",
    "from_stage": "STAGE",
    "subjects": "LIST",
    "expressions": "LIST",
    "neutral": "EXPRESSION",
    "deployment": "F/N",
    "gpus": "N",
}


def seconds(text: str) -> float:
    """ "90s", "30m", "2h", "7d" or a plain number of seconds.

    Raises:
        ValueError: anything else.
    """
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?)([smhd]?)", text.strip())
    if match is None or float(match[1]) <= 0:
        raise ValueError(f"{text!r} is no time: a number above 0 and s, m, h or d, such as 90s or 2h")
    return float(match[1]) * UNITS[match[2] or "s"]


def a_time(text: str) -> float:
    """As argparse wants it."""
    try:
        return seconds(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(str(e)) from e


def add_request_options(
    parser: Any, model: type[BaseModel], only: Collection[str] = (), without: Collection[str] = ()
) -> None:
    """An option for each field of `model`. only, without: names of fields. The first required field is positional."""
    names = [n for n in model.model_fields if (not only or n in only) and n not in without]
    first = next((n for n in names if model.model_fields[n].is_required()), None)
    for name in names:
        _add(parser, name, model.model_fields[name], positional=name == first)


def _add(parser: Any, name: str, field: FieldInfo, positional: bool) -> None:
    description = (field.description or "").replace("%", "%%")
    if positional:
        parser.add_argument(name, metavar=name.upper(), help=description)
        return
    flag = f"--{name.replace('_', '-')}"
    if name == "sets":
        parser.add_argument(
            "--set", dest="sets", action="append", default=[], metavar="STAGE.KEY=VALUE", help=description
        )
    elif name == "config":
        parser.add_argument(flag, metavar="FILE", help="settings from a .toml or .json file, a table for each stage")
    elif field.annotation is bool:
        parser.add_argument(flag, action="store_true", help=description)
    else:
        parser.add_argument(flag, required=field.is_required(), **_value(name, field, description))


def _value(name: str, field: FieldInfo, description: str) -> dict[str, Any]:
    """The arguments of argparse for an option with a value."""
    default = None if field.is_required() else field.default
    shown = "" if default is None else f" ({default})"
    out: dict[str, Any] = {"default": default}
    if name in METAVARS:
        out["metavar"] = METAVARS[name]
    if name in TIMES:
        shown = "" if default is None else f" ({default / 3600:g}h)" if default >= 3600 else f" ({default:g}s)"
        out |= {"type": a_time, "metavar": "TIME"}
        description += "; 90s, 10m, 2h"
    elif name == "store":
        out["default"] = os.environ.get("NEUFACE_STORE")
        description += ", or $NEUFACE_STORE"
    else:
        kinds = [field.annotation, *get_args(field.annotation)]
        choices = next((get_args(k) for k in kinds if get_origin(k) is Literal), None)
        out |= {"choices": choices} if choices else {"type": int} if int in kinds else {}
    return {**out, "help": description + shown}


def request_from(options: argparse.Namespace, model: type[M]) -> M:
    """The request that the options make.

    Raises:
        UsageError: a value outside its limits.
    """
    given = {n: getattr(options, n) for n in model.model_fields if hasattr(options, n)}
    file = given.get("config")
    given["sets"] = tuple(given["sets"])
    given["config"] = read_config_file(Path(file)) if file else {}
    try:
        return model(**given)
    except ValidationError as e:
        first = e.errors()[0]
        name = str(first["loc"][0])
        raise UsageError(
            "an option is outside its limits",
            where=f"--{name.replace('_', '-')}",
            value=repr(first["input"]),
            limit=first["msg"],
            remedy=f"change it: {model.model_fields[name].description}",
        ) from e


def with_provenance(options: argparse.Namespace, config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings with --author, --license and --subject-consent among those of the usd stage."""
    given = {n: getattr(options, n) for n in ("author", "license", "subject_consent")}
    stated = {k: v for k, v in given.items() if v is not None}
    return {**config, "usd": {**config.get("usd", {}), **stated}} if stated else dict(config)


def with_viewer(options: argparse.Namespace, config: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings without the report's 3D view, where --no-viewer asks for that."""
    return {**config, "report": {**config.get("report", {}), "viewer": False}} if options.no_viewer else dict(config)
