"""Sixty-four neighbours at once, as the bits of a word: what numba has no expression for."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import DTypeLike, NDArray

WORD = 64


def padded(width: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros that `bits_from` can read from any of them, or from the one behind.

    Parameters
    ----------
    width : int
        Number of zeros.
    dtype : dtype
        float32 or uint8.
    """
    return np.zeros((width // WORD + 2) * WORD, dtype)[:width]


@intrinsic
def bits_from(typingctx: Any, values: Any, at: Any) -> Any:
    """Bits of 64 values: set where a float is not negative, an integer not zero.

    Parameters
    ----------
    typingctx
        Is numba's own; callers leave it out.
    values : ndarray of float32 or uint8
        Made by `padded`: nothing checks that the 64 lie in the array.
    at : int
        Index of the first.
    """
    number = ir.FloatType() if isinstance(values.dtype, types.Float) else ir.IntType(8)
    assert values.dtype in (types.float32, types.uint8)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        words = ir.VectorType(number, WORD)
        place = builder.bitcast(builder.gep(array.data, [arguments[1]]), words.as_pointer())
        loaded = builder.load(place, align=1)
        none = ir.Constant(words, None)
        if isinstance(number, ir.FloatType):
            found = builder.fcmp_ordered(">=", loaded, none)
        else:
            found = builder.icmp_unsigned("!=", loaded, none)
        return builder.bitcast(found, ir.IntType(WORD))

    return types.uint64(values, types.int64), generate


@intrinsic
def lowest_bit(typingctx: Any, word: Any) -> Any:
    """Place of the lowest bit that is set.

    Parameters
    ----------
    typingctx
        Is numba's own; callers leave it out.
    word : uint64
        Not 0.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), generate
