"""How a viewer asks something of a run in another process: one small file in OUT/live.

It names the run by the random id in state.json, so that a wish for an earlier run changes nothing of a later one. Who
may write in OUT may steer the run.
"""

from __future__ import annotations

import json
import secrets
from pathlib import Path

from workflows.live.folder import ASK, FOLDER, STATE, is_state, put_whole, read_small
from workflows.run.steering import WISHES, is_wish


class Wishes:
    """Reads the wishes for one run. run: its id."""

    def __init__(self, out: Path, run: str) -> None:
        self.path, self.run = out / FOLDER / ASK, run
        self._last: str | None = None
        self._seen: tuple[int, int] | None = None

    def __call__(self) -> str | None:
        """A wish that was not read yet; None without one."""
        try:
            found = self.path.lstat()
        except OSError:
            return None
        if (found.st_mtime_ns, found.st_ino) == self._seen:
            return None
        self._seen = found.st_mtime_ns, found.st_ino
        asked = read_small(self.path)
        number, wish = asked.get("number"), asked.get("wish")
        if asked.get("run") != self.run or not is_wish(wish) or not isinstance(number, str) or number == self._last:
            return None
        self._last = number
        return str(wish)


def ask(out: Path, wish: str) -> bool:
    """Leave a wish for the run that works in `out`. False if none told of itself there.

    Raises:
        ValueError: no such wish.
        OSError: the folder can't be written.
    """
    if not is_wish(wish):
        raise ValueError(f"{wish!r} is none of {', '.join(WISHES)}, a preset or a budget")
    state = read_small(out / FOLDER / STATE)
    if not is_state(state) or not isinstance(state.get("run"), str):
        return False
    content = {"run": state["run"], "number": secrets.token_hex(8), "wish": wish}
    put_whole(out / FOLDER / ASK, json.dumps(content).encode())
    return True
