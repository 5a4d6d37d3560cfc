"""Networks are read one at a time, once a thread."""

from __future__ import annotations

import threading
import time
from pathlib import Path

from pipeline.networks import network


def test_one_at_a_time_and_once_a_thread() -> None:
    reading, most, found = 0, 0, []

    def read(path: str) -> object:
        nonlocal reading, most
        reading += 1
        most = max(most, reading)
        time.sleep(0.01)
        reading -= 1
        return object()

    def work() -> None:
        start.wait()
        a, b = network(Path("one.onnx"), read), network(Path("one.onnx"), read)
        assert a is b and network(Path("two.onnx"), read) is not a
        found.append(a)

    start = threading.Barrier(6)
    threads = [threading.Thread(target=work) for _ in range(6)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert most == 1 and len({id(x) for x in found}) == 6
