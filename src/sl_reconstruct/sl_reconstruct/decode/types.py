"""What decoding works on and gives: arrays as kernels take them, a plan, one line per row."""

from __future__ import annotations

from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from sl_common.kernel_cache import kernel

#: Grey values as a camera gives them: a stack (N, H, W), an image, or a row of one.
Pixels = NDArray[np.uint8] | NDArray[np.uint16]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Integers = NDArray[np.int64]
#: A number in a kernel, whichever its precision.
Real = float | np.floating

#: Columns of `Layout.sources`.
IMAGE, INVERSE, HALF_PERIOD, RISING, EDGES, CENTRES = range(6)


class Layout(NamedTuple):
    """The plan of one axis as arrays.

    Parameters
    ----------
    sources : ndarray, (n, 6)
        Image, inverse (-1: none), half period D, first rising boundary, whether edges and centres
        are asked for.
    edge_owner, centre_owner : ndarray, (boundaries,)
        Which source gives each boundary, -1 for none.
    bits : ndarray, (m, 3)
        The Gray code: image, inverse, whether flipped.
    images : ndarray, (i,)
        All images of the axis.
    white, black : int
        Index of the fully lit and the dark image, -1 where there is none.
    dynamic : bool
        Whether some source is a single image, which needs a threshold per pixel.
    centres : ndarray, (c, 3)
        First and last boundary, plus 1, of each run that centres give, and how far away the edges
        of these centres are.
    """

    sources: Integers
    edge_owner: Integers
    centre_owner: Integers
    bits: Integers
    images: Integers
    white: int
    black: int
    dynamic: bool
    centres: Integers


class Lines(NamedTuple):
    """What is found along rows; kernels of a single row get its part of every array.

    Parameters
    ----------
    u_px : ndarray, (rows, boundaries)
        Camera column of the boundary, NaN where it was not found.
    sigma_px : ndarray, (rows, boundaries)
        Its standard deviation by noise, where it was found.
    width_px : ndarray, (rows, boundaries)
        Width of the edge over the expected one.
    level_dn : ndarray, (rows, boundaries)
        Light under the edge when all is lit, DN.
    reason : ndarray, (rows, boundaries)
        `Reason` why it was not found.
    tally : ndarray, (rows, sources, 2)
        Crossings that were accepted, and those whose identity did not agree.
    """

    u_px: Floats
    sigma_px: Floats
    width_px: Floats
    level_dn: Floats
    reason: Bytes
    tally: NDArray[np.int32]

    def part(self, first: int, last: int) -> Lines:
        """Rows ``first:last``, as views.

        Parameters
        ----------
        first, last : int
            First row, and the one behind the last.
        """
        return Lines(
            self.u_px[first:last],
            self.sigma_px[first:last],
            self.width_px[first:last],
            self.level_dn[first:last],
            self.reason[first:last],
            self.tally[first:last],
        )


@kernel(forceinline=True)
def line_at(lines: Lines, row: int) -> Lines:
    """One of the rows, as views.

    Parameters
    ----------
    lines : Lines
        All rows.
    row : int
        The one wanted.
    """
    return Lines(
        lines.u_px[row],
        lines.sigma_px[row],
        lines.width_px[row],
        lines.level_dn[row],
        lines.reason[row],
        lines.tally[row],
    )


class Noise(NamedTuple):
    """Pixel noise: variance = ``read_dn2 + shot_dn * level``, DN^2."""

    read_dn2: float
    shot_dn: float

    def variance(self, level_dn: float) -> float:
        """Variance of a pixel at a level, DN^2."""
        return self.read_dn2 + self.shot_dn * level_dn


def contiguous(images: Pixels) -> Pixels:
    """Images as kernels take them: one after the other in memory, a copy only if need be."""
    return cast(Pixels, np.ascontiguousarray(images))
