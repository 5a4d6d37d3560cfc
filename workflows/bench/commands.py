"""`neuface bench WHAT`: measurements that repeat. One line of BENCHES is all that a further one needs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

from workflows.bench import ablations, captures, machine, speed, tradeoff
from workflows.cli.console import Console


@dataclass(frozen=True, slots=True)
class Bench:
    """A measurement: its help, its options, and what runs it."""

    help: str
    options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Console], int]


BENCHES: dict[str, Bench] = {
    "captures": Bench(
        "every capture of a folder with its split: one table, by which changes are judged",
        captures.options,
        captures.run,
    ),
    "ablations": Bench(
        "the paper's other systems at one budget: Tables 2, 3, A2 and Fig. A3",
        ablations.options,
        ablations.run,
    ),
    "tradeoff": Bench(
        "single knobs against time, memory and accuracy, with the Pareto front",
        tradeoff.options,
        tradeoff.run,
    ),
    "speed": Bench("rays, pictures and SH evaluations a second; how time and memory grow", speed.options, speed.run),
    "machine": Bench(
        "what this machine can do, and how far each stage of a run is from the least time there",
        machine.options,
        machine.run,
    ),
}


def add_commands(parser: argparse.ArgumentParser) -> None:
    """The sub-commands of `neuface bench`."""
    of = parser.add_subparsers(dest="bench", required=True, metavar="WHAT")
    for name, bench in BENCHES.items():
        sub = of.add_parser(name, help=bench.help)
        bench.options(sub)
        sub.set_defaults(run=bench.run)
