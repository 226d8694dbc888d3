"""Files are whole or absent, bytes are reproducible, and no pickle gets in or out."""

import math
import os
import re
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.workflow.command import ROOT, wait_until
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.report import rendering

ARRAYS = {
    "signal/0/output": np.random.default_rng(3).standard_normal((50, 2)),
    "response": np.array([1 + 2j, np.nan, np.inf]),
    "count": np.array(7),
    "label": np.array("θ [rad] <b>"),
    "names": np.array(["a", "long name"]),
    "flag": np.array([True, False]),
    "empty": np.zeros((0, 3)),
}


def test_npz_round_trip_is_exact(tmp_path):
    """By us and by numpy itself."""
    storage.write_bytes(tmp_path / "a.npz", storage.npz_bytes(ARRAYS))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        for back in (storage.read_npz(tmp_path / "a.npz"), dict(archive)):
            assert back.keys() == ARRAYS.keys()
            for name, array in ARRAYS.items():
                assert back[name].dtype == array.dtype
                np.testing.assert_array_equal(back[name], array)


def test_equal_arrays_give_equal_bytes(monkeypatch):
    first = storage.npz_bytes(ARRAYS)
    monkeypatch.setattr(time, "time", lambda: 1e9)  # zip stores times
    assert storage.npz_bytes({name: array.copy() for name, array in ARRAYS.items()}) == first


def test_objects_are_refused_on_writing():
    with pytest.raises(TypeError, match=r"'bad'.*pickle"):
        storage.npz_bytes({"bad": np.array([{"a": 1}], dtype=object)})


def test_pickle_is_refused_on_reading(tmp_path):
    np.savez(tmp_path / "a.npz", bad=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match=r"a\.npz") as caught:
        storage.read_npz(tmp_path / "a.npz")
    assert "unsafe" not in str(caught.value)  # numpy's own words recommend allow_pickle


def test_output_file_is_tried_before_the_work(tmp_path):
    storage.check_writable(tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="it is a directory"):
        storage.check_writable(tmp_path)
    with pytest.raises(InputError, match=r"cannot write /proc/a\.npz: [^/]*$"):
        storage.check_writable(Path("/proc/a.npz"))


def _device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))  # a null of our own
        path.write_bytes(b"")  # a mount may say that its devices are none
    except OSError as error:
        pytest.skip(f"no device can be made here: {error}")


PLACES = {
    "nothing": lambda path: None,
    "file": lambda path: path.write_bytes(b"old"),
    "link": lambda path: path.symlink_to("target"),
    "link to nothing": lambda path: path.symlink_to("gone"),
    "chain of links": lambda path: path.symlink_to("folder/next"),
    "pipe": os.mkfifo,
    "link to a pipe": lambda path: path.symlink_to("fifo"),
    "device": _device,
}


@pytest.fixture
def place(tmp_path):
    """Something of this kind at a path, and what reads what is written there."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "target").write_bytes(b"old")
    (tmp_path / "folder/next").symlink_to("../target")
    os.mkfifo(tmp_path / "fifo")

    def made(kind: str) -> tuple[Path, Callable[[], bytes]]:
        PLACES[kind](path := tmp_path / "a.html")
        if "pipe" not in kind:
            return path, path.read_bytes
        end = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        return path, lambda: os.read(end, 2**16) + bytes(os.close(end) or 0)

    return made


@pytest.mark.parametrize("kind", PLACES)
def test_only_a_regular_file_is_replaced(kind, place, tmp_path):
    """What the path is it stays, and who reads there gets all of the content."""
    path, read = place(kind)
    links = {one: os.readlink(one) for one in tmp_path.rglob("*") if one.is_symlink()}
    kinds = {one: stat.S_IFMT(one.lstat().st_mode) for one in tmp_path.rglob("*")}
    storage.check_writable(path)
    storage.write_together({path: b"x" * 5000, tmp_path / "beside": b"y"})
    assert read() == (b"" if kind == "device" else b"x" * 5000)
    assert (tmp_path / "beside").read_bytes() == b"y"
    assert {one: os.readlink(one) for one in tmp_path.rglob("*") if one.is_symlink()} == links
    assert kinds.items() <= {one: stat.S_IFMT(one.lstat().st_mode) for one in tmp_path.rglob("*")}.items()
    assert not list(tmp_path.rglob(f"*{storage.TEMPORARY_SUFFIX}"))


@pytest.mark.parametrize("kind", ["link", "pipe", "device"])
def test_commands_write_where_a_path_leads(kind, place, tmp_path, flexlink, monkeypatch):
    monkeypatch.setattr(rendering, "render_page", lambda *_, **__: SimpleNamespace(html="page"))
    path, read = place(kind)
    (log := tmp_path / "log.csv").write_text(
        "t_s,u,y\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(40))
    )
    assert flexlink("look", log, "--out", path).code == 0
    assert read() == (b"" if kind == "device" else b"page")
    assert path.is_symlink() or not path.is_file()


def test_a_place_that_takes_nothing_is_one_line_and_nothing_is_written(tmp_path):
    (old := tmp_path / "old").write_bytes(b"old")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "far").symlink_to("nowhere/file")
    with open(tmp_path / "out", "wb") as stream, pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fstat", lambda number, fstat=os.fstat: fstat(stream.fileno()))
        with pytest.raises(InputError, match="standard output goes there already"):
            storage.check_writable(tmp_path / "out")
    for name, why in {"pipe": "that nobody reads", "loop": "symbolic links", "far": "directory"}.items():
        with pytest.raises(InputError, match=f"^cannot write {tmp_path / name}: .*{why}") as caught:
            storage.write_together({old: b"new", tmp_path / name: b"x"})
        assert "\n" not in str(caught.value)
        if name != "pipe":  # who opens and leaves a pipe ends its reader
            with pytest.raises(InputError, match=r"^cannot write"):
                storage.check_writable(tmp_path / name)
    assert old.read_bytes() == b"old"
    assert {one.name for one in tmp_path.iterdir()} == {"old", "pipe", "loop", "far", "out"}


def test_no_other_code_writes_files():
    """One place knows what an output path may be; compiled templates are no output."""
    writes = re.compile(r"\.write_(text|bytes)\(|\bopen\([^)\n]*[\"'][wax]b?\+?[\"']|os\.(replace|rename)\(")
    for room in ("workflow", "flexlink", "validation"):
        for file in sorted((ROOT / room).rglob("*.py")):
            found = {
                m[0]
                for line in file.read_text().splitlines()
                if "storage." not in line
                for m in writes.finditer(line)
            }
            assert not found or file.name in ("storage.py", "templates.py"), (file, found)


characters = st.characters(exclude_characters="\0", exclude_categories=["Cs"])  # NUL is refused on reading
# Those that begin with "$" are the codec's own.
keys = st.text(characters, max_size=8).filter(lambda key: not key.startswith("$"))
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | st.text(characters),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=10,
)


def _same(left, right):
    if isinstance(left, float) and math.isnan(left):
        return isinstance(right, float) and math.isnan(right)
    if isinstance(left, list):
        return len(left) == len(right) and all(map(_same, left, right))
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(_same(left[key], right[key]) for key in left)
    return type(left) is type(right) and left == right


@settings(max_examples=40)
@given(document=st.dictionaries(keys, json_values))
def test_json_round_trip_keeps_nan_and_infinity(document, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "document.json"
    storage.write_json(path, document)
    assert _same(document, storage.read_json(path))


def test_a_reader_never_sees_half_a_file_while_the_writer_is_killed(tmp_path):
    """Kill -9 a process that rewrites one file without pause; whatever is there must be whole."""
    path = tmp_path / "a.npz"
    code = (
        "import sys, numpy as np; from pathlib import Path; from workflow.engine import storage\n"
        "k = 0\n"
        "while True:\n"
        "    k += 1\n"
        "    arrays = {'a': np.full(40_000, k), 'b': np.array(k)}\n"
        "    storage.write_bytes(Path(sys.argv[1]), storage.npz_bytes(arrays))\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(path)], cwd=ROOT)
    wait_until(path.exists, writer)
    for _ in range(60):
        content = storage.read_npz(path)
        assert np.all(content["a"] == content["b"])
    writer.kill()
    writer.wait()
    content = storage.read_npz(path)
    assert np.all(content["a"] == content["b"])
    storage.remove_leftovers(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.npz"]


def test_file_hash_is_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert storage.sha256_of_file(tmp_path / "a") == (
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
