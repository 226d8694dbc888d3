"""Eight numbers as one value in compiled code, so that a kernel written for one candidate runs for eight.

numba's compiler joins independent scalar computations into vector instructions only in simple loops over
arrays; a recursion over samples, done for eight candidates at once, is not such a loop. `Lanes` is LLVM's own
vector <8 x double>, which every processor supports (as two or four narrower registers where it must). Inside
compiled functions: + - * between lanes, `splat` of a number, `load` from and `store` to eight neighbouring
places of a contiguous one-dimensional array, `shifted` to move them up by one lane, and their `total`.
Products and sums may be fused, as elsewhere in the kernels.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.core.extending import intrinsic, models, register_model
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

WIDTH = 8
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


_LANES = _LanesType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)  # type: ignore[no-untyped-call]


def _add_operator(function: Any, build: str) -> None:
    @infer_global(function)  # type: ignore[no-untyped-call]
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if args == (_LANES, _LANES):
                return signature(_LANES, _LANES, _LANES)  # type: ignore[no-untyped-call]
            return None

    @lower_builtin(function, _LANES, _LANES)  # type: ignore[no-untyped-call]
    def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, build)(*args, flags=("contract",))


_add_operator(operator.add, "fadd")
_add_operator(operator.sub, "fsub")
_add_operator(operator.mul, "fmul")


def _splat(typing_context: Any, value: Any) -> Any:
    """The same number in all lanes."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = builder.insert_element(
            ir.Constant(_VECTOR, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0)
        )
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
        return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), zeros)

    return _LANES(types.float64), build


def _place(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index : index + 8] of a contiguous one-dimensional array, unchecked."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_place(context, builder, sig.args[0], args[0], args[1]), align=8)

    return _LANES(array, types.intp), build


def _store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 8] = value, unchecked."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _place(context, builder, sig.args[0], args[0], args[1]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, _LANES), build


def _shifted(typing_context: Any, lanes: Any, value: Any) -> Any:
    """Every number one lane further up, the last one dropped, and the value in lane 0."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        first = builder.insert_element(
            ir.Constant(_VECTOR, ir.Undefined), args[1], ir.Constant(ir.IntType(32), 0)
        )
        # Indices from WIDTH on name the second vector.
        order = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [WIDTH, *range(WIDTH - 1)])
        return builder.shuffle_vector(args[0], first, order)

    return _LANES(_LANES, types.float64), build


def _total(typing_context: Any, lanes: Any) -> Any:
    """Sum of the eight numbers."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        parts = [builder.extract_element(args[0], ir.Constant(ir.IntType(32), i)) for i in range(WIDTH)]
        while len(parts) > 1:
            parts = [builder.fadd(a, b) for a, b in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    return types.float64(_LANES), build


# Their signatures inside compiled code are not those of the functions above.
splat: Any = intrinsic(_splat)
load: Any = intrinsic(_load)
store: Any = intrinsic(_store)
shifted: Any = intrinsic(_shifted)
total: Any = intrinsic(_total)
