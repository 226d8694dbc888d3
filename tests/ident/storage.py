"""Results of identification through the codec that stores them, for the tests of each."""

from __future__ import annotations

import io
from typing import TypeVar

import numpy as np

from workflow.engine import codec

T = TypeVar("T")


def same(one: object, other: object) -> bool:
    """Whether two results agree in every field, bit for bit."""
    (document, arrays), (again, others) = codec.pack(one), codec.pack(other)
    return document == again and all(
        arrays[name].tobytes() == others[name].tobytes() for name in arrays | others
    )


def stored_and_read(value: T) -> T:
    """The value written to an npz file and read again; the same bit for bit."""
    stream = io.BytesIO()
    np.savez(stream, **codec.to_arrays(value))
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as stored:
        again = codec.from_arrays(type(value), dict(stored))
    assert same(again, value)
    return again
