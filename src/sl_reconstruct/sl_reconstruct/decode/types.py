"""What decoding works on and gives: the plan of one axis as arrays, and one line per row."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Layout(NamedTuple):
    """The plan of one axis as arrays.

    ``sources``: (n, 6) image, inverse, half period, rising, edges, centres. ``edge_owner``,
    ``centre_owner``: which source gives each boundary, -1 for none. ``bits``: (m, 3) image,
    inverse, flipped. ``images``: all images of the axis. ``dynamic``: some source
    is a single image; ``centres``: (c, 3) first and last boundary, plus 1, of each run of those
    that centres give, and how far from them their edges are.
    """

    sources: NDArray[np.int64]
    edge_owner: NDArray[np.int64]
    centre_owner: NDArray[np.int64]
    bits: NDArray[np.int64]
    images: NDArray[np.int64]
    white: int
    black: int
    dynamic: bool
    centres: NDArray[np.int64]


class Lines(NamedTuple):
    """Results for all rows: shape (rows, boundaries), and counts (rows, sources, 2).

    ``tally`` counts the crossings that were accepted and those whose identity did not agree.
    """

    u_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]
    width_px: NDArray[np.float32]
    level_dn: NDArray[np.float32]
    reason: NDArray[np.uint8]
    tally: NDArray[np.int32]
