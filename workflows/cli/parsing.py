"""A parser of options that says which word was meant: "unknown option --presett; did you mean --preset?"."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Collection, Sequence
from typing import Any

SIGNED = ("--light",)  # options whose values may begin with a minus


def meant(word: str, choices: Collection[str]) -> str:
    """ "; did you mean run?", or nothing where no choice is like the word."""
    near = difflib.get_close_matches(word, list(choices), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def joined(words: Sequence[str]) -> list[str]:
    """`--light -0.3,0.4,1.2` as one word: argparse takes a value that begins with a minus for an option."""
    out: list[str] = []
    for word in words:
        if out and out[-1] in SIGNED and re.match(r"-[\d.]", word) and "--" not in out:
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


class Parser(argparse.ArgumentParser):
    """As argparse's, for a command and all of its sub-commands. Wrong usage exits with code 2.

    fill: adds the options, the first time that this parser parses. What it needs is loaded then and not before.
    """

    fill: Callable[[argparse.ArgumentParser], None] | None = None

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """As argparse's; an option that no command knows is an error here, before missing ones are complained of."""
        fill, self.fill = self.fill, None
        if fill is not None:
            fill(self)
        words = joined(sys.argv[1:] if args is None else list(args))
        self._refuse_unknown(words if self._subparsers is None else words[: self._own(words)])
        return super().parse_known_args(words, namespace)

    def _refuse_unknown(self, words: Sequence[str]) -> None:
        known = list(self._option_string_actions)
        for word in words:
            if word == "--":
                return
            name = word.partition("=")[0]
            if name.startswith("--") and not any(option.startswith(name) for option in known):
                self.error(f"unknown option {name}{meant(name, known)}")

    @staticmethod
    def _own(words: Sequence[str]) -> int:
        """How many words come before the sub-command."""
        return next((i for i, word in enumerate(words) if not word.startswith("-")), len(words))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(c) for c in action.choices]
            text = f"{value!r} is not one of {', '.join(choices)}{meant(str(value), choices)}"
            raise argparse.ArgumentError(action, text)
