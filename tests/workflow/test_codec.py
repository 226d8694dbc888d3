"""The codec: every result comes back as it was, and nothing is guessed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest

from workflow.engine import codec, storage
from workflow.engine.codec import CodecError
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import IdentifiedPlant, RunResults
from workflow.tasks.stages import STAGES


class Colour(Enum):
    RED = "like a rose"


@dataclass(frozen=True)
class Small:
    number: float


@dataclass(frozen=True)
class Other:
    number: float


@dataclass(frozen=True, eq=False)
class Everything:
    """One field of every kind that results have."""

    text: str
    count: int
    yes: bool
    gain: float
    root: complex
    colour: Colour
    which: Literal["a", "b"]
    signal: npt.NDArray[np.float64]
    pair: tuple[float, str]
    several: tuple[Small, ...]
    by_name: dict[str, tuple[float, ...]]
    table: Mapping[str, Any]
    either: Small | Other | None = None
    matrix: npt.NDArray[np.complex128] | None = None
    again: Callable[[], int] = int


VALUE = Everything(
    text="θ <b>\0",
    count=3,
    yes=True,
    gain=float("-inf"),
    root=1e-300 + 2j,
    colour=Colour.RED,
    which="b",
    signal=np.arange(6.0).reshape(2, 3)[:, ::2],
    pair=(0.1, "x"),
    several=(Small(1.0), Small(float("nan"))),
    by_name={"a b": (1.0, 2.0)},
    table={"x": [1, None, {"y": 2.5}]},
    either=Other(7.0),
)


def same(one: Any, two: Any) -> bool:
    """Equal to the last bit: equal values have equal files."""
    return storage.npz_bytes(codec.to_arrays(one)) == storage.npz_bytes(codec.to_arrays(two))


def test_a_value_of_every_kind_comes_back():
    back = codec.from_arrays(Everything, codec.to_arrays(VALUE))
    assert same(back, VALUE)
    for name in ("text", "count", "yes", "gain", "root", "colour", "which", "pair", "by_name", "table"):
        assert getattr(back, name) == getattr(VALUE, name)
    assert back.either == Other(7.0)
    assert back.several[0] == Small(1.0)
    assert back.matrix is None
    np.testing.assert_array_equal(back.signal, VALUE.signal)
    assert back.signal.flags.c_contiguous


@pytest.mark.parametrize("stage", [stage.name for stage in STAGES])
def test_every_result_of_a_run_comes_back(fast_run, stage):
    result = getattr(RunResults(RunDirectory.open(fast_run[0])), stage)
    back = codec.from_arrays(type(result), codec.to_arrays(result))
    assert same(result, back)


def test_a_plant_is_read_without_its_file_naming_the_type(fast_run):
    channel = RunResults(RunDirectory.open(fast_run[0])).uncertainty.channels[0]
    plant = IdentifiedPlant(channel.nominal, channel.posterior, channel.level)
    assert same(codec.from_arrays(IdentifiedPlant, codec.to_arrays(plant)), plant)
    with pytest.raises(CodecError, match="holds no IdentifiedPlant"):
        codec.from_arrays(IdentifiedPlant, {"a": np.zeros(2)})


def document(**changes: Any) -> tuple[Any, dict[str, Any]]:
    found, arrays = codec.pack(VALUE)
    return {**found, **changes}, arrays


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"strange": 1}, r"Everything: unknown field 'strange'"),
        ({"count": 1.5}, r"Everything\.count: expected int, got 1\.5"),
        ({"count": True}, r"Everything\.count: expected int, got True"),
        ({"gain": "1"}, r"Everything\.gain: expected float"),
        ({"which": "c"}, r"Everything\.which: expected one of 'a', 'b', got 'c'"),
        ({"colour": "BLUE"}, r"Everything\.colour: expected one of RED"),
        ({"pair": [1.0]}, r"Everything\.pair: expected 2 entries"),
        ({"several": [{"$type": "Other", "number": 1.0}]}, r"several\[0\]: is .*Other, expected Small"),
        ({"several": [{"$type": "Small"}]}, r"several\[0\]: missing field 'number'"),
        ({"signal": {"$array": "elsewhere"}}, r"signal: expected an array that is in the archive"),
        ({"either": {"$type": "Everything"}}, r"either: Everything is none of"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_place(changes, complaint):
    with pytest.raises(CodecError, match=complaint) as raised:
        codec.unpack(Everything, *document(**changes))
    assert "\n" not in str(raised.value)


def test_a_missing_field_is_refused():
    found, arrays = document()
    del found["text"]
    with pytest.raises(CodecError, match="missing field 'text'"):
        codec.unpack(Everything, found, arrays)


def test_objects_and_functions_are_not_stored():
    with pytest.raises(TypeError, match="pickle"):
        codec.pack(replace(VALUE, signal=np.array([object()])))
    with pytest.raises(TypeError, match="cannot be stored"):
        codec.pack(replace(VALUE, table={"x": print}))
    assert "again" not in codec.pack(VALUE)[0]


def test_plain_is_json_without_our_tags():
    found = codec.plain(VALUE, arrays=False)
    assert found["gain"] is None
    assert found["root"] == [1e-300, 2.0]
    assert found["colour"] == "RED"
    assert "signal" not in found
    assert codec.plain(VALUE)["signal"] == [[0.0, 2.0], [3.0, 5.0]]
