"""Start a program that ends when the process that started it ends, in whatever way.

python -m workflows.server.kept_child PARENT ARGUMENTS...    runs `python ARGUMENTS...`; PARENT: the asking process's id
"""

import os
import sys

from workflows.run.interrupt import end_with

if __name__ == "__main__":
    end_with(int(sys.argv[1]))
    os.execv(sys.executable, [sys.executable, *sys.argv[2:]])  # the kernel's promise outlives it
