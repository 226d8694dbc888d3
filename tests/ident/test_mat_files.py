"""MATLAB files against scipy's writer, and files that once ended the process."""

import io
import resource
import struct
import subprocess
import sys

import numpy as np
import pytest
import scipy.io

from ident.data import foreign_files
from ident.data.mat_files import mat_variables

RNG = np.random.default_rng(14)
CELLS = np.array([1.0, "a"], dtype=object)
VALUES = {
    "real": RNG.normal(size=(7, 3)),
    "row": RNG.normal(size=(1, 9)),
    "whole": np.arange(12, dtype=np.int16).reshape(3, 4),
    "single": RNG.normal(size=(2, 2, 3)).astype(np.float32),
    "complex": RNG.normal(size=(4, 1)) + 1j * RNG.normal(size=(4, 1)),
    "logical": np.array([[True, False]]),
    "none": np.zeros((0, 0)),
}


def written(variables, **options):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, **options)
    return buffer.getvalue()


@pytest.mark.parametrize("packed", [False, True])
def test_everything_that_scipy_writes_comes_back(packed):
    nested = {"t": np.arange(3.0), "inner": {"y": np.ones(2)}, "label": "Größe [µm]", "cells": CELLS}
    found = mat_variables(
        written(VALUES | {"log": nested, "rows": ["ab", "cde"]}, do_compression=packed), "f"
    )
    for name, value in VALUES.items():
        np.testing.assert_array_equal(found[name], value)
    log = found["log"]
    np.testing.assert_array_equal(log["t"].ravel(), nested["t"])
    np.testing.assert_array_equal(log["inner"]["y"].ravel(), [1, 1])
    assert log["label"] == nested["label"]
    assert (log["cells"][0].item(), log["cells"][1]) == (1.0, "a")
    assert found["rows"] == ["ab", "cde"]


def test_what_is_no_array_is_told_when_it_is_asked_for():
    found = mat_variables(written({"s": scipy.sparse.eye_array(3).tocsc(), "x": 1.0}), "f")
    assert found["x"].item() == 1.0
    assert "sparse matrix" in found["s"].why


def opaque(name):
    """An object of MATLAB's own, as of `string`: a variable of class 17 without a name where scipy looks."""

    def element(kind, content):
        return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)

    flags, sizes = (struct.pack("<II", kind, 0) for kind in (17, 13)), struct.pack("<ii", 6, 1)
    place = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    own, of_array = flags
    array = element(6, of_array) + element(5, sizes) + element(1, b"") + element(6, place)
    return element(
        14,
        element(6, own)
        + b"".join(element(1, text) for text in (name, b"MCOS", b"string"))
        + element(14, array),
    )


def test_objects_of_matlab_do_not_hide_the_vectors_beside_them():
    content = written({"t": np.arange(4.0)}) + opaque(b"s1") + opaque(b"s2") + opaque(b"s3")
    found = mat_variables(content, "f")
    np.testing.assert_array_equal(found.pop("t"), [[0, 1, 2, 3]])
    assert all("a MATLAB object" in other.why for other in found.values())


def test_a_reader_keeps_to_limits_that_are_there():
    """Of time and memory: an allowance of its own that is larger cannot be had."""

    def less():
        resource.setrlimit(resource.RLIMIT_CPU, (100, 100))
        resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32))

    done = subprocess.run(
        [sys.executable, "-I", str(foreign_files._SCRIPT), "mat"],
        input=written({"t": 1.0}), capture_output=True, preexec_fn=less, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout


def test_names_that_crash_compiled_readers_are_refused():
    once = written({"ab": 1.0})
    # The name of two letters stands beside its tag.
    tag = struct.pack("<HH", 1, 2) + b"ab"
    assert tag in once
    for content in (once + once[128:], once.replace(tag, tag[:4] + b"a\0")):
        with pytest.raises(ValueError, match=r"^f: .*damaged"):
            mat_variables(content, "f")


def test_lengths_are_believed_no_further_than_the_bytes_go():
    content = written({"x": np.arange(4.0)})
    dimensions = struct.pack("<ii", 1, 4)
    assert content.count(dimensions) == 1
    too_many = content.replace(dimensions, struct.pack("<ii", 1, 2**31 - 1))
    for one in (too_many, content[:-8]):
        with pytest.raises(ValueError, match=r"^f: not a MATLAB .mat file"):
            mat_variables(one, "f")
