"""Exponential and logarithm for compiled loops, written out.

Of a call of the C library the compiler makes no vector instructions; of these it does, so that sixteen cost
what one did. They are inlined into the loops. numba keeps compiled code by the date of the file of a loop:
who changes something here must touch the files of the loops, too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

f32 = np.float32
HALF, ONE, LOG2_E = f32(0.5), f32(1.0), f32(1.44269504)
LN2_HIGH, LN2_LOW = f32(0.693359375), f32(-2.12194440e-4)


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def exp(x: Any) -> Any:
    """e to the power of x in float32, to 1e-7 of it (Cephes, ``expf``)."""
    x = min(max(x, f32(-87.0)), f32(88.0))
    n = np.floor(x * LOG2_E + HALF)
    r = x - n * LN2_HIGH - n * LN2_LOW
    p = (f32(1.9875691500e-4) * r + f32(1.3981999507e-3)) * r + f32(8.3334519073e-3)
    p = ((p * r + f32(4.1665795894e-2)) * r + f32(1.6666665459e-1)) * r + f32(5.0000001201e-1)
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return (p * r * r + r + ONE) * power


@njit(nogil=True, cache=True, fastmath=True, error_model="numpy", inline="always")
def log(x: Any) -> Any:
    """Natural logarithm of a positive number in float32, to 2e-7 (Cephes, ``logf``)."""
    bits = f32(x).view(np.int32)
    n = (bits - np.int32(0x3F3504F3)) >> np.int32(23)
    m = np.int32(bits - (n << np.int32(23))).view(np.float32) - ONE
    p = (f32(7.0376836292e-2) * m + f32(-1.1514610310e-1)) * m + f32(1.1676998740e-1)
    p = ((p * m + f32(-1.2420140846e-1)) * m + f32(1.4249322787e-1)) * m + f32(-1.6668057665e-1)
    p = ((p * m + f32(2.0000714765e-1)) * m + f32(-2.4999993993e-1)) * m + f32(3.3333331174e-1)
    square = m * m
    return m + (m * square * p + f32(n) * LN2_LOW - HALF * square) + f32(n) * LN2_HIGH
