"""Where `neuface` begins: signals first, so that Ctrl-C during the imports (seconds) shows no traceback."""

from workflows.run.interrupt import from_the_start

from_the_start()

from workflows.cli.main import main  # noqa: E402

__all__ = ["main"]
