"""Model files from strangers: damaged bytes, and wrong things in whole files. Every fault is one line."""

import copy
import io
import json

import numpy as np
import pytest
import scipy.io

from ident import GobfModel, Poles
from ident.basis.model_files import ModelFile
from ident.basis.posterior import EmbeddingReport, ResponsePosterior
from ident.data import foreign_files
from tests.ident.mutations import Tally, mutated, tally
from workflow.config.design_file import DesignFile
from workflow.engine import codec, storage
from workflow.engine.errors import InputError
from workflow.tasks.design_source import load_source
from workflow.tasks.results import IdentifiedPlant

MODEL = GobfModel(Poles([0.9, 0.5], [0.8 + 0.3j]), [1.0, 2.0, 3.0, 4.0], 0.005, 0.0, 1, 2, "u_V", "y_rad")
REPORT = EmbeddingReport("tangent", 0.1, 1.0, 0.9, 0.5, 3.0, 100, 4)
HOW = {"integrators": 1, "input_delay_samples": 2, "report": REPORT}
POSTERIOR = ResponsePosterior(MODEL.poles, MODEL.coefficients, 0.01 * np.eye(4), 0.005, **HOW)
ARRAYS = codec.to_arrays(IdentifiedPlant(MODEL, POSTERIOR, 0.95))
DOCUMENT = json.loads(ARRAYS[codec.DOCUMENT].tobytes())
WHOLE = {
    "hub.npz": storage.npz_bytes(ARRAYS),
    "hub.mat": ModelFile(MODEL, POSTERIOR.at(np.linspace(1, 600, 20))).to_mat(),
}


def complaint(path) -> str | None:
    """What is said of a model, None where it is read; only an InputError of one line of 300 is allowed."""
    try:
        assert load_source(path, DesignFile()).plant.dt_s > 0
    except InputError as error:
        line = str(error)
        assert "\n" not in line
        assert str(path) in line
        assert len(line.replace(str(path), path.name)) <= 300
        return line
    return None


def damaged(name, folder, count) -> Tally:
    path = folder / name
    path.write_bytes(WHOLE[name])
    assert complaint(path) is None

    def attempt(rng):
        path.write_bytes(mutated(WHOLE[name], rng))
        said = complaint(path)
        return said and said.replace(str(path), name)

    return tally(attempt, count, 15)


# A process of its own reads a .mat.
@pytest.mark.parametrize("many", [False, pytest.param(True, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", WHOLE)
def test_damaged_bytes(name, many, tmp_path):
    few, often = (2, 15) if name == "hub.mat" else (150, 3000)
    assert damaged(name, tmp_path, often if many else few).wrong == []


STRANGE_VALUES = [
    None, True, 0, -1, 1.5, 1e300, 10**12, "x", "x" * 500, [], {}, [1, 2], {"$float": "nan"}, {"$float": [1]},
    {"$float": "abc"}, {"$array": "nope"}, {"$array": ["a"]}, {"$complex": [1, "a"]}, {"$complex": 3},
    {"$type": "Poles"}, {"$type": ["a"]},
]  # fmt: skip
STRANGE_ARRAYS = [
    lambda a: a.astype(complex) * (1 + 1j), lambda a: a.astype("U8"), lambda a: a * np.nan,
    lambda a: a * 1e200, lambda a: 3 * a, lambda a: a[None], lambda a: a.ravel()[:0], lambda a: a.sum(),
    lambda a: np.array([{}], dtype=object), lambda a: np.zeros(3, dtype=[("a", "f8")]),
    lambda a: np.r_[a.ravel(), a.ravel()], lambda a: np.zeros(a.shape, dtype="M8[s]"),
]  # fmt: skip


def places(document, path=()):
    items = document.items() if isinstance(document, dict) else enumerate(document)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


def written(tmp_path, arrays):
    np.savez(tmp_path / "hub.npz", **arrays)
    return tmp_path / "hub.npz"


@pytest.mark.parametrize("change", range(len(STRANGE_ARRAYS)))
def test_strange_arrays_in_a_whole_npz(change, tmp_path):
    for name in set(ARRAYS) - {codec.DOCUMENT}:
        with np.errstate(over="ignore"):
            complaint(written(tmp_path, ARRAYS | {name: STRANGE_ARRAYS[change](ARRAYS[name])}))


@pytest.mark.parametrize("value", range(len(STRANGE_VALUES)))
def test_strange_values_in_a_whole_npz(value, tmp_path):
    for *way, last in places(DOCUMENT):
        document = copy.deepcopy(DOCUMENT)
        inner = document
        for key in way:
            inner = inner[key]
        inner[last] = STRANGE_VALUES[value]
        text = json.dumps(document).encode()
        complaint(written(tmp_path, ARRAYS | {codec.DOCUMENT: np.frombuffer(text, dtype=np.uint8)}))


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("model/poles/real", np.array([1.5, 0.5]), "inside the unit circle; got 1.5"),
        ("model/coefficients", np.ones(4) * 1j, "model.coefficients: holds complex128, expected float64"),
        ("posterior/mean", np.array([{}] * 4, dtype=object), "'posterior/mean' holds Python objects"),
        ("posterior/covariance_factor", np.array(1.0), "covariance_factor"),
    ],
)
def test_what_is_said_of_a_wrong_array(name, array, words, tmp_path):
    assert words in complaint(written(tmp_path, ARRAYS | {name: array}))


def archive(**change):
    """The bytes of an archive whose first entry is changed in both of its headers (offset, bytes)."""
    content = bytearray(WHOLE["hub.npz"])
    for offset, value in change.values():
        for mark, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
            at = content.index(mark) + 4 + shift + offset
            content[at : at + len(value)] = value
    return bytes(content)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (archive(flags=(2, b"\x01\x00")), "is encrypted"),
        (archive(method=(4, b"\x63\x00")), "packed by method 99"),
        (b"PK\x03\x04 and no more", "not a numpy .npz archive"),
    ],
)
def test_archives_of_another_kind(content, words, tmp_path):
    (tmp_path / "hub.npz").write_bytes(content)
    assert words in complaint(tmp_path / "hub.npz")


def test_an_archive_that_grows(tmp_path, monkeypatch):
    monkeypatch.setattr(foreign_files, "LARGEST_BYTES", 2**20)
    np.savez_compressed(tmp_path / "hub.npz", zeros=np.zeros(2**18))
    assert "unpacks to more than 1 MiB" in complaint(tmp_path / "hub.npz")


@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({"dt_s": [0.005, 0.005]}, "dt_s"),
        ({"A": np.eye(2) * 1j}, "A"),
        ({"A": np.zeros((2, 2), dtype=object)}, "A"),
        ({"C": {"field": 1.0}}, "C"),
    ],
)
def test_state_space_with_the_wrong_things(variables, words, tmp_path):
    plain = {"A": 0.5 * np.eye(2), "B": [[1.0], [0.0]], "C": [[1.0, 1.0]], "D": 0.0, "dt_s": 0.01}
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, plain | variables)
    (tmp_path / "arm.mat").write_bytes(buffer.getvalue())
    assert words in complaint(tmp_path / "arm.mat")
