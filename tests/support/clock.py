"""A wall clock that jumps, for programs that a test starts: a small library that the loader puts before libc."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

CODE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>
/* The wall clock is back by CLOCK_BACK seconds while the file named by CLOCK_JUMP is there. Other clocks go on. */
int clock_gettime(clockid_t which, struct timespec *t) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int done = real(which, t);
  const char *sign = getenv("CLOCK_JUMP"), *back = getenv("CLOCK_BACK");
  if (which == CLOCK_REALTIME && sign && back && access(sign, F_OK) == 0) t->tv_sec -= atol(back);
  return done;
}
"""


def compiler() -> str | None:
    """A C compiler, if this machine has one."""
    return shutil.which("cc")


def jumping_clock(folder: Path, sign: Path, back: int) -> dict[str, str]:
    """Environment of programs whose wall clock is `back` seconds behind while the file `sign` exists.

    The library is built in `folder`. Needs `compiler()`.
    """
    source, library = folder / "clock.c", folder / "clock.so"
    source.write_text(CODE)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return {"LD_PRELOAD": str(library), "CLOCK_JUMP": str(sign), "CLOCK_BACK": str(back)}
