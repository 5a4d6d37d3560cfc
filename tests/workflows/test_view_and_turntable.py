"""The server of `neuface view` answers for one run only; `neuface turntable` writes a film that can be read."""

from __future__ import annotations

import http.client
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from pipeline.errors import UsageError
from workflows.cli import turntable
from workflows.cli.turntable import TurntableRequest, write_turntable
from workflows.cli.view import server_of


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    for name, text in (("run/report/index.html", "page"), ("run/run.json", "{}"), ("secret.txt", "no")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "run/report/link").symlink_to(tmp_path / "secret.txt")
    server, address = server_of(tmp_path / "run")
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield address
    server.shutdown()
    server.server_close()


def ask(address: str, path: str | None = None, host: str | None = None) -> tuple[int, bytes]:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=5)
    connection.putrequest("GET", parts.path if path is None else path, skip_host=True)
    connection.putheader("Host", host or parts.netloc)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_the_report_is_served_on_loopback(served: str) -> None:
    assert urlsplit(served).hostname == "127.0.0.1"
    assert ask(served) == (200, b"page")
    assert ask(served, host=served.split("/")[2].replace("127.0.0.1", "localhost"))[0] == 200


def test_other_hosts_paths_and_tokens_are_refused(served: str) -> None:
    token = urlsplit(served).path.split("/")[1]
    assert ask(served, host="evil.example")[0] == 403
    for path in ("/", "/report/index.html", f"/{token}x/report/index.html", f"/{token}/", f"/{token}/report/",
                 f"/{token}/run.json", f"/{token}/../secret.txt", f"/{token}/report/..%2f..%2fsecret.txt",
                 f"/{token}/report/link", f"/{token}//etc/passwd", f"/{token}/report/%00"):  # fmt: skip
        assert ask(served, path)[0] == 404, path


@pytest.mark.parametrize("kind", ["mp4", "webp"])
def test_a_film_has_its_frames(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of one grey each come back in their order."""
    grey = [np.full((64, 64, 3), 40 * i + 20, np.uint8) for i in range(5)]
    monkeypatch.setattr(turntable, "frames", lambda request: iter(grey))
    path = write_turntable(TurntableRequest(tmp_path, tmp_path / f"new/film.{kind}", frames=5, size=64))
    if kind == "mp4":
        film, found = cv2.VideoCapture(str(path)), []
        while (read := film.read())[0]:
            found.append(read[1])
    else:
        found = list(cv2.imreadanimation(str(path))[1].frames)
    assert [float(f[..., :3].mean()) for f in found] == pytest.approx([20, 60, 100, 140, 180], abs=4)


@pytest.mark.parametrize(("name", "size"), [("film.avi", 64), ("film", 64), ("film.mp4", 65)])
def test_films_that_no_player_shows_are_refused(name: str, size: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="film"):
        write_turntable(TurntableRequest(tmp_path, tmp_path / name, size=size))
