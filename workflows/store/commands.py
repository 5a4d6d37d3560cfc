"""`neuface store ls`, `neuface store gc` and `neuface store purge`."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.errors import StageError
from pipeline.store import LOCKS, Store
from workflows.cli.console import Console
from workflows.run.run_lock import is_held


def add_commands(parser: argparse.ArgumentParser) -> None:
    """The sub-commands and their options."""
    from workflows.cli.options import a_time

    of = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    ls = of.add_parser("ls", help="what takes space, by stage and by run")
    ls.add_argument("store", metavar="STORE", help="the store: OUT/.store, or what --store named")
    ls.set_defaults(run=ls_command)
    gc = of.add_parser("gc", help="remove what no published folder needs; a later run makes it again")
    gc.add_argument("store", metavar="STORE", help="the store: OUT/.store, or what --store named")
    gc.add_argument(
        "--older-than", type=a_time, default="7d", metavar="TIME", help="unused for so long: 12h, 30d (%(default)s)"
    )
    gc.add_argument("--dry-run", action="store_true", help="print what would be removed, and remove nothing")
    gc.set_defaults(run=gc_command)
    purge = of.add_parser("purge", help="remove all that was made from one person's photos (docs/privacy.md)")
    purge.add_argument("subject", metavar="SUBJECT", help="the subject's folder in a batch, or a single run's capture")
    purge.add_argument("--out", required=True, metavar="DIR", help="the --out of that batch or run")
    purge.add_argument("--store", metavar="STORE", help="its store (DIR/.store)")
    purge.add_argument("--dry-run", action="store_true", help="print what would be removed, and remove nothing")
    purge.set_defaults(run=purge_command)


def ls_command(options: argparse.Namespace, console: Console) -> int:
    """neuface store ls"""
    from workflows.store.usage import table, usage

    print("\n".join(table(usage(_store(Path(options.store))))))
    return 0


def gc_command(options: argparse.Namespace, console: Console) -> int:
    """neuface store gc"""
    from workflows.store.gc import garbage, remove

    store = _store(Path(options.store))
    found = garbage(store, options.older_than)
    for piece in found:
        print(f"{piece.size / 1e6:10.1f} MB  {piece.path.relative_to(store.root)}  {piece.why}")
    if not options.dry_run:
        remove(store, found)
    done = "would be removed" if options.dry_run else "removed"
    print(f"{len(found)} pieces, {sum(p.size for p in found) / 1e6:.1f} MB {done}")
    return 0


def purge_command(options: argparse.Namespace, console: Console) -> int:
    """neuface store purge"""
    from workflows.store.gc import belongings, purge

    out = Path(options.out)
    store = _store(Path(options.store) if options.store else out / ".store")
    found = belongings(options.subject, out, store)
    if not found.paths:
        raise StageError(
            "nothing is known of this subject",
            where=out,
            value=options.subject,
            limit="the name of a subject's folder in this batch, or of this run's capture",
            remedy="look at DIR/batch/index.html or DIR/run.json for its name; name the store with --store",
        )
    busy = [o for o in found.outs if is_held(store.root, o)]
    if busy and not options.dry_run:
        raise StageError(
            "a run of this subject is under way",
            where=busy[0],
            value=f"{len(busy)} of its folders are written to",
            limit="none: what is removed would be made again",
            remedy="stop the run, or wait for its end, and repeat the command",
        )
    size = found.size
    for path in found.paths:
        print(path)
    if options.dry_run:
        print(f"{len(found.paths)} paths, {size / 1e6:.1f} MB would be removed")
    else:
        left = purge(found, store)
        if left:
            raise StageError(
                "not all could be removed",
                where=left[0],
                value=f"{len(left)} of {len(found.paths)} paths are still there",
                limit="none",
                remedy="stop the runs that work on them, look at the permissions, and repeat the command",
            )
        print(f"{len(found.paths)} paths, {size / 1e6:.1f} MB removed")
    for path in found.users:
        print(f"a file of your own, yours to remove: {path}")
    for path in found.unsure:
        print(f"not removed, as an older version did not record of which video in its folder it is: {path}")
    for photos in found.photos:
        print(f"the photos themselves are yours to remove: {photos}")
    return 0


def _store(path: Path) -> Store:
    if not (path / LOCKS).is_dir():  # every store has one; what lies in another folder is none of our business
        raise StageError(
            "there is no store",
            where=path,
            value="a folder without finished stages" if path.is_dir() else "nothing",
            limit="the folder of finished stages of a run",
            remedy="name OUT/.store, or the folder that --store named",
        )
    return Store(path)
