"""Compiled loops of :mod:`tco.warped`: a source's pixels looked up in a target, compared, and derived.

Arrays are float32 and contiguous; pictures are (C, H, W). Divisions by zero are not looked for, without which
the compiler makes no vector instructions of a loop. Helpers are inlined: a function that is called could be
linked in another form when it is read from disk than when it was compiled, and round otherwise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float32]
f32 = np.float32
HALF, ONE = f32(0.5), f32(1.0)
FAST = {"reassoc", "contract", "nsz", "arcp"}  # sums in any order, but what is not finite stays so
Index = np.uint64  # not below zero: of a signed one numba looks whether it counts from the end


class Target(NamedTuple):
    """What a source is looked up in.

    Attributes:
        image: (C, H, W), flat. inverse: (H, W) its inverse depth, flat. valid: (H, W) 1 or 0, flat.
        pose: (3, 4) that takes the source's pixel (x, y, 1) times its depth, and 1, to a homogeneous pixel.
    """

    image: Floats
    inverse: Floats
    valid: Floats
    pose: Floats


class Found(NamedTuple):
    """What is found there, all (·, H, W), written by :func:`look_up`.

    Attributes:
        color: (C, H, W). slope: (C, H, W) its derivative by the source's depth.
        weight: (H, W), 0 where a pixel does not count.
    """

    color: Floats
    slope: Floats
    weight: Floats


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _project(depth: Floats, m: Floats, y: int, at: Floats) -> None:
    """Where a row of pixels (w,) falls: u, v and z, and the derivatives of u and v by the depth, (5, w)."""
    py = f32(y) + HALF
    a0, b0, c0 = m[0, 1] * py + m[0, 2], m[1, 1] * py + m[1, 2], m[2, 1] * py + m[2, 2]
    u, v, z, du, dv = at[0], at[1], at[2], at[3], at[4]
    for x in range(len(depth)):
        z[x] = depth[x] * (m[2, 0] * (f32(x) + HALF) + c0) + m[2, 3]
    for x in range(len(depth)):
        a, c = m[0, 0] * (f32(x) + HALF) + a0, m[2, 0] * (f32(x) + HALF) + c0
        u[x] = (depth[x] * a + m[0, 3]) / z[x]
        du[x] = (a - u[x] * c) / z[x]
    for x in range(len(depth)):
        b, c = m[1, 0] * (f32(x) + HALF) + b0, m[2, 0] * (f32(x) + HALF) + c0
        v[x] = (depth[x] * b + m[1, 3]) / z[x]
        dv[x] = (b - v[x] * c) / z[x]


@njit(nogil=True, cache=True, error_model="numpy")
def look_up(depth: Floats, opacity: Floats, tolerance: float, target: Target, found: Found) -> int:
    """Fill ``found`` for the pixels of a source; returns how many fall on the target's picture.

    Args:
        depth: (H, W) of the source.
        opacity: (H, W) weights of its pixels.
        tolerance: a pixel that is deeper than what the target shows by more than this part is hidden.
        target: see there.
        found: see there; zeros where the source's pixel is not on the picture.
    """
    h, w = depth.shape
    inside, most, at = 0, f32(1 + tolerance), np.empty((5, w), np.float32)
    channels = Index(len(found.color))
    right, bottom = f32(w) - HALF, f32(h) - HALF
    for y in range(h):
        _project(depth[y], target.pose, y, at)
        for x in range(w):
            u, v, z = at[0, x], at[1, x], at[2, x]
            if not (z > f32(1e-3) and u >= HALF and v >= HALF and u <= right and v <= bottom):
                found.weight[y, x] = 0
                for k in range(channels):
                    found.color[k, y, x] = found.slope[k, y, x] = 0
                continue
            inside += 1
            i, j = int(u - HALF), int(v - HALF)
            fx, fy = u - HALF - f32(i), v - HALF - f32(j)
            gx, gy = ONE - fx, ONE - fy
            one, below = Index(j * w + i), Index(min(j + 1, h - 1) * w + i)
            step = Index(i + 1 < w)
            for k in range(channels):
                first = k * Index(h * w)
                p, q = target.image[first + one], target.image[first + one + step]
                r, s = target.image[first + below], target.image[first + below + step]
                found.color[k, y, x] = gy * (gx * p + fx * q) + fy * (gx * r + fx * s)
                across, down = gy * (q - p) + fy * (s - r), gx * (r - p) + fx * (s - q)
                found.slope[k, y, x] = across * at[3, x] + down * at[4, x]
            p, q, r, s = gx * gy, fx * gy, gx * fy, fx * fy
            far, valid = target.inverse, target.valid
            inverse = p * far[one] + q * far[one + step] + r * far[below] + s * far[below + step]
            whole = p * valid[one] + q * valid[one + step] + r * valid[below] + s * valid[below + step]
            counts = whole > f32(1 - 1e-4) and not z * inverse > most
            found.weight[y, x] = opacity[y, x] if counts else f32(0)
    return inside


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def exposure(found: Found, image: Floats, matched: Any) -> float:
    """Bring the colours to the weighted mean and deviation of the source's; the slopes with them.

    As :func:`tco.objective.match_exposure`. What has no weight takes the source's colour and no slope,
    whether the exposure is to be ``matched`` or not. Returns the sum of the weights.
    """
    channels, h, w = image.shape
    weight = found.weight
    total = np.float64(0)
    for y in range(h):
        for x in range(w):
            total += weight[y, x]
    for k in range(channels):
        gain, bias = f32(1), f32(0)
        if matched:
            gain, bias = _gain(found.color[k], image[k], weight, max(total, 1e-12))
        for y in range(h):
            for x in range(w):
                there = weight[y, x] > 0
                found.color[k, y, x] = gain * found.color[k, y, x] + bias if there else image[k, y, x]
                found.slope[k, y, x] = gain * found.slope[k, y, x] if there else f32(0)
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _gain(color: Floats, image: Floats, weight: Floats, total: float) -> Any:
    """Gain and bias of one channel (H, W)."""
    h, w = weight.shape
    mean, aim, own, wanted = 0.0, 0.0, 0.0, 0.0
    for y in range(h):
        for x in range(w):
            mean += weight[y, x] * color[y, x]
            aim += weight[y, x] * image[y, x]
    mean, aim = mean / total, aim / total
    for y in range(h):
        for x in range(w):
            own += weight[y, x] * (color[y, x] - mean) ** 2
            wanted += weight[y, x] * (image[y, x] - aim) ** 2
    gain = min(max(np.sqrt((wanted / total + 1e-4) / (own / total + 1e-4)), 0.5), 2.0)
    return f32(gain), f32(aim - gain * mean)


@njit(nogil=True, cache=True, inline="always")
def _reflected(i: int, n: int) -> int:
    """Index of the pixel that stands at place ``i`` of a line of n that is reflected about its outermost."""
    i = abs(i)
    return i if i < n else 2 * (n - 1) - i


TAPS = 7
"""Of the window along an axis: of a sum of so many the compiler makes one loop of vector instructions."""


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _along(line: Floats, kernel: Floats, out: Floats) -> None:
    """Sum under the window of a line (w + ``TAPS`` − 1,), (w,)."""
    w = len(out)
    a, b, c, d, e, f, g = line[:w], line[1:], line[2:], line[3:], line[4:], line[5:], line[6:]
    for x in range(w):
        out[x] = (
            kernel[0] * a[x] + kernel[1] * b[x] + kernel[2] * c[x] + kernel[3] * d[x]
            + kernel[4] * e[x] + kernel[5] * f[x] + kernel[6] * g[x]
        )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _across(rows: Floats, first: tuple[int, ...], kernel: Floats, out: Floats) -> None:
    """Sum under the window of some rows (·, w), added to (w,)."""
    i, j, k, l, m, n, o = first  # noqa: E741
    a, b, c, d, e, f, g = rows[i], rows[j], rows[k], rows[l], rows[m], rows[n], rows[o]
    for x in range(len(out)):
        out[x] += (
            kernel[0] * a[x] + kernel[1] * b[x] + kernel[2] * c[x] + kernel[3] * d[x]
            + kernel[4] * e[x] + kernel[5] * f[x] + kernel[6] * g[x]
        )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def blur(plane: Floats, kernel: Floats, out: Floats) -> None:
    """Mean (H, W) of a plane (H, W) under a window, reflected about the outermost pixels.

    Args:
        plane: of more than half of ``TAPS`` pixels each way.
        kernel: (``TAPS``,) weights of the window along each axis.
        out: where it goes.
    """
    h, w = plane.shape
    p = TAPS // 2
    line = np.empty(w + 2 * p, np.float32)
    for y in range(h):
        line[:] = 0
        rows = (
            _reflected(y - 3, h), _reflected(y - 2, h), _reflected(y - 1, h), y,
            _reflected(y + 1, h), _reflected(y + 2, h), _reflected(y + 3, h),
        )  # fmt: skip
        _across(plane, rows, kernel, line[p : p + w])
        for i in range(1, p + 1):
            line[p - i], line[p + w - 1 + i] = line[p + i], line[p + w - 1 - i]
        _along(line, kernel, out[y])


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def spread(grad: Floats, kernel: Floats, out: Floats) -> None:
    """The transpose of :func:`blur`: gradients (H, W) of the means to those of the plane."""
    h, w = grad.shape
    p = TAPS // 2
    wide, line = np.zeros(w + 4 * p, np.float32), np.empty(w + 2 * p, np.float32)
    rows = np.zeros((h + 4 * p, w), np.float32)
    for y in range(h):
        wide[2 * p : 2 * p + w] = grad[y]
        _along(wide, kernel, line)
        for i in range(1, p + 1):
            line[p + i] += line[p - i]
            line[p + w - 1 - i] += line[p + w - 1 + i]
        rows[2 * p + y] = line[p : p + w]
    out[:] = 0
    for y in range(h + 2 * p):
        _across(rows, (y, y + 1, y + 2, y + 3, y + 4, y + 5, y + 6), kernel, out[_reflected(y - p, h)])


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _parts(ma: Any, mb: Any, product: Any, squares: Any, c1: Any, c2: Any) -> tuple[Any, Any, Any, Any]:
    """A, B, C and D of :func:`_similar`; ``squares`` is E a² + E b²."""
    both, own = ma * mb, ma * ma + mb * mb
    return f32(2) * both + c1, f32(2) * (product - both) + c2, own + c1, squares - own + c2


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _similar(
    means: Floats, of_image: Floats, weight: Floats, terms: tuple[float, float, float], partial: Floats
) -> float:
    """Weighted sum of (1 − SSIM) / 2 of a channel, times a factor, and what it changes with.

    With A = 2 μa μb + C₁, B = 2 (E ab − μa μb) + C₂, C = μa² + μb² + C₁ and
    D = E a² − μa² + E b² − μb² + C₂, SSIM = A B / (C D).

    Args:
        means: (3, H, W) μa, E a² and E ab.
        of_image: (2, H, W) μb and E b².
        weight: (H, W) of the pixels.
        terms: the factor, C₁ and C₂.
        partial: (3, H, W) where the derivatives by the means go.
    """
    h, w = weight.shape
    factor, c1, c2 = f32(terms[0] / 2), f32(terms[1]), f32(terms[2])
    total, same, up = np.float64(0), np.empty(w, np.float32), np.empty(w, np.float32)
    for y in range(h):
        # One array is written in each loop: of more the compiler would not check that they lie apart.
        ma, mb, product, share = means[0, y], of_image[0, y], means[2, y], weight[y]
        squares_a, squares_b = means[1, y], of_image[1, y]
        of_mean, of_square, of_product = partial[0, y], partial[1, y], partial[2, y]
        for x in range(w):
            A, B, C, D = _parts(ma[x], mb[x], product[x], squares_a[x] + squares_b[x], c1, c2)
            same[x] = A * B / (C * D)
        line = f32(0)
        for x in range(w):
            line += share[x] * factor * max(ONE - same[x], f32(0))
        total += line
        for x in range(w):
            up[x] = -share[x] * factor if same[x] <= ONE else f32(0)
        for x in range(w):
            A, B, C, D = _parts(ma[x], mb[x], product[x], squares_a[x] + squares_b[x], c1, c2)
            of_mean[x] = f32(2) * up[x] * (mb[x] * (B - A) - ma[x] * same[x] * (D - C)) / (C * D)
        for x in range(w):
            A, _, C, D = _parts(ma[x], mb[x], product[x], squares_a[x] + squares_b[x], c1, c2)
            of_product[x] = f32(2) * up[x] * A / (C * D)
        for x in range(w):
            _, _, _, D = _parts(ma[x], mb[x], product[x], squares_a[x] + squares_b[x], c1, c2)
            of_square[x] = -up[x] * same[x] / D
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def _structure(
    pair: tuple[Floats, Floats], of_image: Floats, weight: Floats, kernel: Floats,
    terms: tuple[float, float, float], work: Floats,
) -> float:  # fmt: skip
    """Weighted sum of (1 − SSIM) / 2 of a channel, times a factor; its derivative is added to ``work[0]``.

    Arguments as in :func:`_similar` and :func:`compare`; the pair is the channel of target and source.
    """
    a, b = pair
    h, w = a.shape
    grad, means, partial = work[0], work[1:4], work[4:7]
    partial[0], partial[1] = a * a, a * b
    blur(a, kernel, means[0])
    blur(partial[0], kernel, means[1])
    blur(partial[1], kernel, means[2])
    total = _similar(means, of_image, weight, terms, partial)
    for k in range(3):
        spread(partial[k], kernel, means[k])
    for y in range(h):
        row, of_mean, of_square, of_product = grad[y], means[0, y], means[1, y], means[2, y]
        ours, theirs = a[y], b[y]
        for x in range(w):
            row[x] += of_mean[x] + f32(2) * ours[x] * of_square[x] + theirs[x] * of_product[x]
    return total


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def compare(
    found: Found, image: Floats, of_image: Floats, kernel: Floats, terms: tuple[float, float, float],
    work: Floats, slope: Floats,
) -> float:  # fmt: skip
    """Weighted sum of the differences of what was found in a target; the derivative by the depth is added.

    Args:
        found: after :func:`exposure`.
        image: (C, H, W) of the source.
        of_image: (C, 2, H, W) means under the window of each channel and of its square.
        kernel: (``TAPS``,) of the window; empty: no structural term.
        terms: share of the structural term, and C₁ and C₂ of SSIM.
        work: (7, H, W) to write in.
        slope: (H, W) that the derivative is added to.
    """
    channels, h, w = image.shape
    plain, factor = f32((1 - terms[0]) / channels), terms[0] / channels
    total, grad = np.float64(0), work[0]
    for k in range(channels):
        for y in range(h):
            a, b, share, row = found.color[k, y], image[k, y], found.weight[y], grad[y]
            line = f32(0)
            for x in range(w):
                line += share[x] * abs(a[x] - b[x])
            total += plain * line
            for x in range(w):
                row[x] = share[x] * plain * (f32(a[x] > b[x]) - f32(a[x] < b[x]))
        if len(kernel) > 0:
            pair, of_pair = (found.color[k], image[k]), (factor, terms[1], terms[2])
            total += _structure(pair, of_image[k], found.weight, kernel, of_pair, work)
        for y in range(h):
            into, row, moved = slope[y], grad[y], found.slope[k, y]
            for x in range(w):
                into[x] += row[x] * moved[x]
    return total
