"""Named points in a child process at which a test stops, holds or kills it: no clock decides what a fault meets.

A child reaches a point by `reach("work.step")`. What happens there is told by its environment:

    NEUFACE_TEST_POINT   "NAME", "NAME@3" (the third time it is reached by this process)
    NEUFACE_TEST_ACTION  kill: SIGKILL to the child's whole process group; hold: wait for the test's word
    NEUFACE_TEST_SIGNS   folder; the sign "NAME.PID" appears when the point is reached, and a held child goes on when
                         the test has written the file "go" there

Run as a program it is `neuface` with all its real stages, which reach "STAGE.begin", "STAGE.end" (its result is in
the store) and "fit.checkpoint" (one was written): python -m tests.support.points run CAPTURE --out DIR.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PATIENCE = 600.0  # seconds until a test gives up on a child: a limit for what never comes, not for what is slow
_SEEN: Counter[str] = Counter()


# ------------------------------------------------------------------ in the child
def reach(name: str, stopped: Callable[[], bool] = lambda: False) -> None:
    """Do at this point what the environment says. A held child also goes on when it is told to stop."""
    point, _, time_of = os.environ.get("NEUFACE_TEST_POINT", "").partition("@")
    if point != name:
        return
    _SEEN[name] += 1
    if _SEEN[name] != int(time_of or 1):
        return
    signs = Path(os.environ["NEUFACE_TEST_SIGNS"])
    (signs / f"{name}.{os.getpid()}").write_text("")
    if os.environ["NEUFACE_TEST_ACTION"] == "kill":
        os.killpg(os.getpgid(0), signal.SIGKILL)
    while not ((signs / "go").exists() or stopped()):
        time.sleep(0.01)


def instrument() -> None:
    """Let the real stages and the fit's checkpoints reach their points."""
    from stages.inverse_rendering import training_loop
    from stages.inverse_rendering.fit import Trainer

    if os.environ.get("NEUFACE_TEST_POINT", "").startswith("fit.checkpoint"):
        training_loop.CHECKPOINT_SHARE = 1e9  # after each step: how often one is due goes by the clock otherwise
    save = Trainer.save

    def saved(self: Trainer, *rest: Any) -> None:
        save(self, *rest)
        reach("fit.checkpoint")

    instrument_store()
    Trainer.save = saved  # type: ignore[method-assign]


def instrument_store() -> None:
    """Let the begin and the end of every stage, real or not, reach their points."""
    from pipeline.store import Store

    begin, finish = Store.begin, Store.finish

    def begun(self: Store, stage: str, *rest: Any) -> Any:
        out = begin(self, stage, *rest)
        reach(f"{stage}.begin")
        return out

    def finished(self: Store, stage: str, *rest: Any) -> Any:
        out = finish(self, stage, *rest)
        reach(f"{stage}.end")
        return out

    Store.begin, Store.finish = begun, finished  # type: ignore[method-assign]


def before(point: str, call: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which reaches a point before its work."""

    def reached(*arguments: Any, **options: Any) -> Any:
        reach(point)
        return call(*arguments, **options)

    return reached


def after(point: str, call: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which reaches a point after its work."""

    def reaches(*arguments: Any, **options: Any) -> Any:
        made = call(*arguments, **options)
        reach(point)
        return made

    return reaches


# ------------------------------------------------------------------ in the test
@dataclass(frozen=True)
class Point:
    """A point of a child, as the test sees it."""

    name: str
    signs: Path
    action: str

    def environment(self) -> dict[str, str]:
        """What the child needs to know."""
        self.signs.mkdir(parents=True, exist_ok=True)
        return {
            "NEUFACE_TEST_POINT": self.name,
            "NEUFACE_TEST_ACTION": self.action,
            "NEUFACE_TEST_SIGNS": str(self.signs),
        }

    def reached(self) -> list[int]:
        """The processes that came to the point."""
        name = self.name.partition("@")[0]
        return [int(p.suffix[1:]) for p in self.signs.glob(f"{name}.*")]

    def wait(self, *children: subprocess.Popen[str] | subprocess.Popen[bytes], processes: int = 1) -> None:
        """Until so many processes are at the point. A child that ends before is a failure, told with what it said."""

        def there() -> bool:
            if len(self.reached()) >= processes:
                return True
            for child in children:
                assert child.poll() is None, f"ended before {self.name}: {child.communicate()}"
            return False

        wait_for(there)

    def release(self) -> None:
        """Let the held processes go on."""
        (self.signs / "go").write_text("")

    def take_back(self) -> None:
        """Hold those that come from now on; the signs of those that came before are gone."""
        (self.signs / "go").unlink()
        for sign in self.signs.glob(f"{self.name.partition('@')[0]}.*"):
            sign.unlink()


def hold(name: str, signs: Path) -> Point:
    """A point at which a child waits for `release`."""
    return Point(name, signs, "hold")


def kill(name: str, signs: Path) -> Point:
    """A point at which a child and its whole process group are killed."""
    return Point(name, signs, "kill")


def wait_for(condition: Callable[[], Any], seconds: float = PATIENCE, every: float = 0.02) -> None:
    """Until something is true, looked at `every` so many seconds; the limit is for what never happens."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(every)


def read_until(stream: Any, words: str) -> str:
    """What a child writes up to the line with these words. The end of the stream before it is a failure."""
    said = []
    for line in stream:
        said.append(line)
        if words in line:
            return "".join(said)
    raise AssertionError(f"ended without {words!r}: {''.join(said)}")


if __name__ == "__main__":
    from workflows.cli.main import main

    instrument()
    sys.exit(main())
