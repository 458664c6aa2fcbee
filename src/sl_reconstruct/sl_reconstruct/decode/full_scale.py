"""Where the pixels of a stack end: 10, 12 and 14 bits come in 16-bit images."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sl_reconstruct.decode.settings import Settings

#: Significant bits that cameras have.
BITS = (8, 10, 12, 14, 16)
#: What 8 bits in the upper end of 16 are multiples of.
MAX_STEP = 256


def saturation_of(stack: NDArray[Any], settings: Settings) -> int:
    """Value from which on pixels are saturated: as chosen, else the stack's full scale."""
    return settings.saturation_dn or full_scale_dn(stack)


def full_scale_dn(stack: NDArray[Any]) -> int:
    """Largest value that a pixel of these images can have, as far as they show it.

    Parameters
    ----------
    stack : ndarray of uint8 or uint16
        Images as the camera gave them.

    Returns
    -------
    int
        255 for uint8. For uint16 the end of the fewest bits of `BITS` that hold all values; of
        values that are all multiples of 2, 4, ... (bits put in the upper end), that multiple less.
        Too few bits are taken for images whose brightest pixel is below a quarter of the full
        scale: nothing is saturated there, whatever the number.

    Examples
    --------
    >>> full_scale_dn(np.array([17, 4095], np.uint16)), full_scale_dn(np.array([4096], np.uint16))
    (4095, 16383)
    >>> full_scale_dn(np.array([0x0110, 0xFFF0], np.uint16))  # 12 bits in the upper end
    65520
    """
    if stack.dtype == np.uint8:
        return 255
    used = int(np.bitwise_or.reduce(stack, axis=None))
    bits = next(bits for bits in BITS if used < 1 << bits)
    step = min(used & -used, MAX_STEP) if bits == BITS[-1] else 1
    return (1 << bits) - step
