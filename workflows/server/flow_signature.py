"""A flow's parameters from a pydantic model: one description for the command line, the checks and the server's form."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, TypeVar

from pydantic import BaseModel

R = TypeVar("R")


def takes(model: type[BaseModel]) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """Give a function of keywords the fields of `model` as its parameters, with types, limits, defaults and help.

    Prefect reads types, limits and defaults from the signature and descriptions from the docstring's `Args`.
    """

    def wrap(function: Callable[..., R]) -> Callable[..., R]:
        fields = model.model_fields
        lines = [f"    {name}: {field.description}" for name, field in fields.items()]
        function.__doc__ = "\n".join([inspect.getdoc(function) or "", "", "Args:", *lines])
        function.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [
                inspect.Parameter(
                    name,
                    inspect.Parameter.KEYWORD_ONLY,
                    annotation=Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation,
                    default=inspect.Parameter.empty if field.is_required() else field.default,
                )
                for name, field in fields.items()
            ]
        )
        return function

    return wrap
