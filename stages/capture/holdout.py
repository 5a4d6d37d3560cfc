"""Which views are held out, that is, never fitted: grammar and meaning of the rule.

none              no view
every:N:K         views with index % N == K
names:a.jpg,b     views by file name or stem
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePath

from pipeline.errors import UsageError


def check_rule(rule: str) -> str:
    """The rule itself if its grammar is right. Raises UsageError otherwise."""
    every = re.fullmatch(r"every:(\d+):(\d+)", rule)
    if rule == "none" or (every and 0 <= int(every[2]) < int(every[1])):
        return rule
    if rule.startswith("names:") and all(n.strip() for n in rule[6:].split(",")):
        return rule
    raise UsageError(
        "the hold-out rule is not understood",
        where="holdout",
        value=rule,
        limit="none | every:N:K with K < N | names:a.jpg,b.jpg",
        remedy="write for example every:5:2, which holds out views 2, 7, 12, ...",
    )


def held_out(rule: str, views: Sequence[tuple[int, str]], absent: Sequence[str] = ()) -> frozenset[int]:
    """Indices of held-out views.

    views: (index, file name) of every view that is used. absent: names of photos that are left out.
    Raises UsageError for a name that is not in the capture.
    """
    check_rule(rule)
    if rule == "none":
        return frozenset()
    if rule.startswith("every:"):
        n, k = map(int, rule.split(":")[1:])
        return frozenset(i for i, _ in views if i % n == k)
    by_name = {n: i for i, name in views for n in (PurePath(name).stem, name)}
    known = by_name.keys() | {n for name in absent for n in (PurePath(name).stem, name)}
    wanted = [n.strip() for n in rule[6:].split(",")]
    unknown = [n for n in wanted if n not in known]
    if unknown:
        names = [name for _, name in views]
        raise UsageError(
            "a held-out view is not in the capture",
            where="holdout",
            value=", ".join(unknown),
            limit=f"one of {names[0]} ... {names[-1]} ({len(names)} views)",
            remedy="write the photo's file name as it is in the folder, with or without its suffix",
        )
    return frozenset(by_name[n] for n in wanted if n in by_name)
