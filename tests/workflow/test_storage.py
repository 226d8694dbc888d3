"""Files are whole or absent, bytes are reproducible, and no pickle gets in or out."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from workflow.engine import storage
from workflow.engine.errors import InputError

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
    storage.write_bytes(tmp_path / "a.npz", storage.npz_bytes(ARRAYS))
    back = storage.read_npz(tmp_path / "a.npz")
    assert back.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)


def test_equal_arrays_give_equal_bytes():
    first = storage.npz_bytes(ARRAYS)
    time.sleep(2.1)  # zip stores times in steps of two seconds
    assert storage.npz_bytes({name: array.copy() for name, array in ARRAYS.items()}) == first


def test_numpy_itself_reads_the_file(tmp_path):
    storage.write_bytes(tmp_path / "a.npz", storage.npz_bytes(ARRAYS))
    with np.load(tmp_path / "a.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["response"], ARRAYS["response"])


def test_objects_are_refused_on_writing(tmp_path):
    with pytest.raises(TypeError, match=r"'bad'.*pickle"):
        storage.npz_bytes({"bad": np.array([{"a": 1}], dtype=object)})
    assert list(tmp_path.iterdir()) == []


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


@pytest.mark.parametrize("content", [b"", b"nonsense", b"PK\x03\x04 cut off"])
def test_damaged_npz_is_one_line(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npz") as caught:
        storage.read_npz(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)


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


@given(document=st.dictionaries(keys, json_values))
def test_json_round_trip_keeps_nan_and_infinity(document, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "document.json"
    storage.write_json(path, document)
    assert _same(document, storage.read_json(path))


def test_failed_write_keeps_the_old_file_and_leaves_no_temporary(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    storage.write_json(path, {"version": 1})

    def no_space(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(InputError, match="No space left"):
        storage.write_json(path, {"version": 2})
    monkeypatch.undo()
    assert storage.read_json(path) == {"version": 1}
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


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
    root = Path(__file__).resolve().parents[2]
    for pause in (0.0, 0.013, 0.027):
        writer = subprocess.Popen([sys.executable, "-c", code, str(path)], cwd=root)
        deadline = time.monotonic() + 20
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        for _ in range(20):
            content = storage.read_npz(path)
            assert np.all(content["a"] == content["b"])
        time.sleep(pause)
        writer.kill()
        writer.wait()
        content = storage.read_npz(path)
        assert np.all(content["a"] == content["b"])
        storage.remove_leftovers(tmp_path)
        assert [entry.name for entry in tmp_path.iterdir()] == ["a.npz"]
        path.unlink()


def test_file_hash_is_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1
    assert storage.sha256_of_file(tmp_path / "a") == (
        "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
