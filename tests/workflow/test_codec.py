"""The codec: every result comes back as it was, and nothing is guessed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, Any, Final, Literal, NewType, TypeVar

import numpy as np
import numpy.typing as npt
import pytest
from typing_extensions import TypeAliasType

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
    text="θ <b>\0", count=3, yes=True, gain=float("-inf"), root=1e-300 + 2j, colour=Colour.RED, which="b",
    signal=np.arange(6.0).reshape(2, 3)[:, ::2], pair=(0.1, "x"), several=(Small(1.0), Small(float("nan"))),
    by_name={"a b": (1.0, 2.0)}, table={"x": [1, None, {"y": 2.5}]}, either=Other(7.0),
)  # fmt: skip


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


Item, Key = TypeVar("Item"), TypeVar("Key")
# What `type X[...] = ...` of Python 3.12 makes, and `numpy.typing.NDArray` of numpy 2.5 with it.
Samples = TypeAliasType(
    "Samples",
    np.ndarray[tuple[Any, ...], np.dtype[Item]],
    type_params=(Item,),  # type: ignore[type-var]
)
Turned = TypeAliasType("Turned", tuple[Key, Item], type_params=(Item, Key))
Shape = TypeAliasType("Shape", Small | Other)
Metre = NewType("Metre", float)


@dataclass(frozen=True, eq=False)
class Named:
    """Annotations that are names for others."""

    signal: Samples[np.float64]
    matrix: Samples[np.complex128] | None
    pair: Turned[str, float]
    rows: tuple[TypeAliasType("Row", Samples[np.float64]), ...]  # type: ignore[valid-type]
    shape: Shape | None
    length: Annotated[Metre | None, "m"]
    always: Final[int]
    again: TypeAliasType("Again", Callable[[], int]) = int  # type: ignore[valid-type]


def test_names_for_kinds_are_read_back_as_the_kinds():
    value = Named(np.arange(3.0), None, (0.5, "x"), (np.ones(2),), Other(7.0), Metre(2.0), 4)
    arrays = codec.to_arrays(value)
    back = codec.from_arrays(Named, arrays)
    assert same(back, value)
    assert (back.pair, back.shape, back.length, back.always) == ((0.5, "x"), Other(7.0), 2.0, 4)
    with pytest.raises(CodecError, match=r"signal: holds .*complex128.*, expected float64"):
        codec.from_arrays(Named, arrays | {"signal": np.ones(3) * 1j})
    with pytest.raises(CodecError, match=r"pair\[0\]: expected float, got 'x'"):
        codec.from_arrays(Named, codec.to_arrays(replace(value, pair=("x", "x"))))


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
        ({"either": {"$type": "Everything"}}, r"either: Everything is not one of"),
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
