"""Where `neuface` begins: signals first, so that Ctrl-C during the imports (seconds) shows no traceback."""

import _signal  # type: ignore[import-not-found]  # part of the interpreter; the module `signal` would be loaded from a file

if _signal.getsignal(_signal.SIGINT) is not _signal.SIG_IGN:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)

from workflows.run.interrupt import from_the_start

from_the_start()

from workflows.cli.main import main  # noqa: E402

__all__ = ["main"]
