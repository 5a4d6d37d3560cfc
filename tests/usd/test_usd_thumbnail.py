"""The thumbnail's file."""

from pathlib import Path

import numpy as np
import pytest

from stages.usd.render import previews


def test_a_thumbnail_stays_in_the_folder_that_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A store that is reached through a symbolic link: paths below it are compared with the link's."""
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")

    class Still:
        def render(self, view: object, light: object) -> np.ndarray:
            return np.ones((8, 8, 4), np.float32)

    monkeypatch.setattr(previews, "framing", lambda *_: None)
    asked = tmp_path / "link" / "." / "default.png"
    found = previews.render_thumbnail(previews.Scene(Still(), None), asked)  # type: ignore[arg-type]
    assert found == tmp_path / "link" / "default.png" and (tmp_path / "real" / "default.png").is_file()
