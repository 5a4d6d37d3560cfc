"""What no module of ours may do with what comes from outside: the rules that can be read off the code."""

from __future__ import annotations

import ast
import json
import zipfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest
import torch

from pipeline.artifacts import FileRef
from pipeline.images import MAX_BYTES
from stages.capture.scan import scan_capture
from stages.usd.check.validate import _image_fault
from tests.support.facescape_tree import write_tree

SOURCES = [p for top in ("pipeline", "stages", "workflows") for p in sorted(Path(top).rglob("*.py"))]


@lru_cache
def trees(repo: Path) -> list[tuple[Path, ast.Module]]:
    return [(s, ast.parse((repo / s).read_text())) for s in SOURCES]


def calls(repo: Path) -> Iterator[tuple[str, str, ast.Call]]:
    """(file, dotted name, call)"""
    for source, tree in trees(repo):
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                yield f"{source}:{node.lineno}", ast.unparse(node.func), node


def keyword(call: ast.Call, name: str) -> object:
    return next((ast.literal_eval(k.value) for k in call.keywords if k.arg == name), None)


@pytest.mark.slow
def test_no_pickle_is_ever_loaded(repo: Path) -> None:
    loads = [(at, name, c) for at, name, c in calls(repo) if name in ("torch.load", "np.load", "numpy.load")]
    assert len(loads) >= 5
    assert [at for at, name, c in loads if name == "torch.load" and keyword(c, "weights_only") is not True] == []
    assert [at for at, name, c in loads if name != "torch.load" and keyword(c, "allow_pickle") is not False] == []


def test_no_code_from_data(repo: Path) -> None:
    banned = ("eval", "exec", "pickle.load", "pickle.loads", "marshal.loads", "yaml.load", "os.system", "joblib.load",
              "torch.hub.load", "shutil.unpack_archive", "tarfile.open")  # fmt: skip
    assert [(at, name) for at, name, _ in calls(repo) if name in banned] == []
    assert [at for at, _, c in calls(repo) if keyword_is_true(c, "shell")] == []
    assert [at for at, name, _ in calls(repo) if name.endswith(".extractall")] == []  # archives are read, not unpacked


def keyword_is_true(call: ast.Call, name: str) -> bool:
    return any(k.arg == name and not (isinstance(k.value, ast.Constant) and not k.value.value) for k in call.keywords)


def test_a_checkpoint_that_would_run_code_is_refused(tmp_path: Path) -> None:
    """What `weights_only` is for, shown on a file that would leave a trace."""

    class Evil:
        def __reduce__(self) -> tuple[object, ...]:
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"a": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(Exception, match="[Ww]eights"):
        torch.load(tmp_path / "evil.pt", weights_only=True)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("path", ["../x", "/etc/passwd", "a/../../x", "a\\..\\x", ""])
def test_paths_in_manifests_stay_in_their_folder(path: str) -> None:
    with pytest.raises(ValueError):
        FileRef(path=path, sha256="0" * 64, size=1)


def test_names_in_params_json_stay_in_their_folder(tmp_path: Path) -> None:
    """Views are numbers, and photos are found by listing the folder: no word of the file ever becomes a path."""
    write_tree(tmp_path, {"1/1_neutral": True})
    folder, secret = tmp_path / "1/1_neutral", tmp_path / "secret.jpg"
    secret.write_bytes((folder / "0.jpg").read_bytes())
    params = json.loads((folder / "params.json").read_text())
    params |= {f"../../secret_{k.partition('_')[2]}": v for k, v in params.items() if k.startswith("0_")}
    params |= {"0_ori": "../../secret.jpg", "0_sn": "../../secret", "1_ori": str(secret)}
    (folder / "params.json").write_text(json.dumps(params))
    scanned = scan_capture(folder).artifact
    assert [p.path for p in scanned.photos] == ["0.jpg", "1.jpg", "2.jpg"]
    assert "secret" not in scanned.model_dump_json()


def test_a_member_of_an_archive_lands_nowhere_else_and_bombs_are_not_unpacked(tmp_path: Path) -> None:
    package, mark = tmp_path / "x.usdz", tmp_path / "mark"
    with zipfile.ZipFile(package, "w") as z:
        z.writestr(f"../../../../../../{mark}.png", b"no picture")
        z.writestr("/bomb.png", b"")
        z.getinfo("/bomb.png").file_size = MAX_BYTES + 1  # what its header would declare
    assert _image_fault(f"{package}[../../../../../../{mark}.png]")
    assert list(tmp_path.iterdir()) == [package]
    assert "larger than 4 GB" in _image_fault(f"{package}[/bomb.png]")


def test_servers_listen_on_this_machine_unless_asked(repo: Path) -> None:
    from workflows.cli.main import parser

    assert parser().parse_args(["serve"]).host == "127.0.0.1"
    text = (repo / "docker/compose.yaml").read_text()
    published = [line for line in text.splitlines() if "ports:" in line or '- "' in line and ":42" in line]
    assert published and all("127.0.0.1:" in line for line in published)
