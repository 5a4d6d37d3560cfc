"""python -m workflows.cli: the same as `neuface`."""

import sys

from workflows.cli.entry import main

if __name__ == "__main__":
    sys.exit(main())
