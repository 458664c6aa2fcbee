"""Signals along a camera row whose zeros are edges or stripe centres."""

from __future__ import annotations

import numpy as np

from sl_common.kernel_cache import kernel
from sl_reconstruct.decode.gray_code import PixelRow
from sl_reconstruct.decode.types import Floats, Pixels


@kernel()
def pair_signal(pattern: Pixels, inverse: Pixels, floor_dn: float, signal: Floats) -> None:
    """Write (P - N) / (P + N): free of albedo and of light that is always there.

    Parameters
    ----------
    pattern, inverse : ndarray, (width,)
        Rows P and N of the two images, DN.
    floor_dn : float
        Keeps the quotient finite, DN.
    signal : ndarray, (width,)
        Written to.
    """
    floor = np.float32(floor_dn)
    for x in range(signal.size):
        a = np.float32(pattern[x])
        b = np.float32(inverse[x])
        signal[x] = (a - b) / (a + b + floor)


@kernel()
def single_signal(image: Pixels, p: PixelRow, floor_dn: float, signal: Floats) -> None:
    """Write (I - T) / (B - D) with the dynamic threshold; zero where it is unknown.

    Parameters
    ----------
    image : ndarray, (width,)
        Row I of the image, DN.
    p : PixelRow
        Has threshold T and light B - D.
    floor_dn : float
        Least light that is divided by, DN.
    signal : ndarray, (width,)
        Written to.
    """
    floor = np.float32(floor_dn)
    threshold, light = p.threshold, p.light
    for x in range(signal.size):
        a = light[x]
        q = (np.float32(image[x]) - threshold[x]) / (a if a > floor else floor)
        signal[x] = q if q == q else np.float32(0)


@kernel()
def smooth(signal: Floats, taps: Floats, out: Floats) -> None:
    """Convolve with a symmetric kernel.

    Parameters
    ----------
    signal : ndarray, (width,)
        Raw samples.
    taps : ndarray, (1 + radius,)
        The kernel from its middle on.
    out : ndarray, (width,)
        Written to; samples that the kernel does not cover keep the raw signal.
    """
    n, radius = signal.size, taps.size - 1
    for x in range(radius):
        out[x] = signal[x]
        out[n - 1 - x] = signal[n - 1 - x]
    inner, mid = out[radius : n - radius], signal[radius : n - radius]
    done = min(4, radius)
    if done == 4:  # one pass for the usual kernels
        _smooth_nine(signal[radius - 4 : n - radius + 4], taps, inner)
    else:
        done = 0
        for x in range(inner.size):
            inner[x] = taps[0] * mid[x]
    for j in range(done + 1, radius + 1):
        left, right = signal[radius - j : n - radius - j], signal[radius + j : n - radius + j]
        w = taps[j]
        for x in range(inner.size):
            inner[x] += w * (left[x] + right[x])


@kernel()
def _smooth_nine(s: Floats, taps: Floats, out: Floats) -> None:
    a, b, c, d, e = taps[0], taps[1], taps[2], taps[3], taps[4]
    n = out.size
    s1, s2, s3, s4, s5 = s[1:], s[2:], s[3:], s[4:], s[5:]
    s6, s7, s8 = s[6:], s[7:], s[8:]
    for x in range(n):
        near = a * s4[x] + b * (s3[x] + s5[x]) + c * (s2[x] + s6[x])
        out[x] = near + d * (s1[x] + s7[x]) + e * (s[x] + s8[x])


@kernel()
def bar_centres(signal: Floats, out: Floats) -> None:
    """BR8, Eq. (6): the four samples on the left minus the four on the right.

    Parameters
    ----------
    signal : ndarray, (width,)
        Raw samples.
    out : ndarray, (width,)
        Written to; 0 where samples are missing.
    """
    n = signal.size
    for x in range(n):
        out[x] = 0
    inner = out[4 : n - 4]
    for j in range(1, 5):
        left, right = signal[4 - j : n - 4 - j], signal[4 + j : n - 4 + j]
        for x in range(inner.size):
            inner[x] += left[x] - right[x]
