"""Compiled loops of :mod:`colmap_tco.fusion`: which views agree on the pixels of a reference.

The pixels are taken in tiles, and each step is a plain loop over a tile without branches and calls,
which the compiler turns into vector instructions; only the reading of the other view's pixels is one
by one. That takes a third of the time of one loop over all steps. Each tile's numbers are rows of one
array, one after the other, since the compiler gives up where it would have to prove of many arrays
that they do not overlap. Arithmetic is in single precision, of which a vector holds twice as many numbers:
coordinates are those of the reference camera, so that the digits go to the scene and not to where it is.
Neighbouring numbers are 0.0005 pixels apart at column 8000.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

TILE = 256
"""Pixels of a tile. A list of M pixels has ``ceil(M / TILE)`` of them."""

# The rows of a tile, as where they begin: the pixel, then the votes on it.
ROW, COL, Z, NX, NY, NZ, CONFIDENCE = range(0, 7 * TILE, TILE)
"""Row, column, depth, normal and confidence of a pixel; depth is NaN after the last pixel."""
SEEN, SUPPORT, CONFLICTS, COSINE = range(7 * TILE, 11 * TILE, TILE)
"""Votes on a pixel: views whose image contains it; that agree, the reference included; that look through
it; cosine of the largest angle between the rays of the reference and of a view that agrees."""
TILE_SIZE = 11 * TILE
"""float32 numbers of a tile; :data:`Tiles` is (tiles, TILE_SIZE)."""

# The rows of one neighbour's votes on a tile.
WEIGHT, OFF, TURNED = 0, TILE, 2 * TILE
"""Where the neighbour agrees, its confidence, its relative depth error, and its normal in the frame of the
reference (three rows); else 0."""
VOTE_SIZE = 5 * TILE
"""float32 numbers of these votes; :data:`Votes` is (tiles, neighbours · VOTE_SIZE)."""

# The rows of the scratch of one tile.
_X, _Y, _DEPTH, _I, _J, _INSIDE = range(0, 6 * TILE, TILE)
"""The point in the other view: ray, depth, column and row of the pixel, and whether it is in the image."""
_D, _N, _C, _ERROR, _BACK, _AGREE, _TURNED, _LIMIT, _OUTCOME = (
    k * TILE for k in (6, 7, 10, 11, 12, 13, 14, 17, 18)
)
"""The other view's depth, normal (three rows) and confidence there; relative depth error, squared
reprojection error, cosine between the normals, the other's normal in the reference frame (three rows),
relative error allowed, and the outcome."""
_SCRATCH = 19 * TILE

Limits = tuple[float, float, float, float, float]
"""Relative depth error, reprojection error in pixels of the map, least cosine between normals,
``sigma_at_one``, ``most_depth_error``; see :class:`colmap_tco.fusion.FusionConfig`."""

UNSEEN, HOLE, OCCLUDED, THROUGH, DEPTH, REPROJECTION, NORMAL, AGREES = range(8)
"""Outcomes of comparing one pixel with one view."""

_MOST_TILT = 1.05
"""Largest ratio of depths within one pixel that is ascribed to a slanted surface."""

Surface = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Of a view: depth (H, W), 0 where it takes no part; normal (H, W, 3); confidence (H, W)."""

Tiles = NDArray[np.float32]
Votes = NDArray[np.float32]
Scratch = NDArray[np.float32]
Pair = NDArray[np.float32]
"""Of :func:`colmap_tco._fusion_kernels.pair`, in single precision."""

_0, _HALF, _1 = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_FLATTEST, _STEEPEST = np.float32(1 / _MOST_TILT), np.float32(_MOST_TILT)
_INFINITE = np.float32(np.inf)


def tiles_of(count: int) -> Tiles:
    """Room for so many pixels."""
    return np.empty((-(-count // TILE), TILE_SIZE), np.float32)


def votes_of(count: int, neighbours: int) -> Votes:
    """Room for the votes of so many neighbours on so many pixels."""
    return np.empty((-(-count // TILE), neighbours * VOTE_SIZE), np.float32)


@njit(cache=True, error_model="numpy", nogil=True)
def begin(ref: Surface, pixels: NDArray[np.int64], tiles: Tiles) -> None:
    """Fill ``tiles`` with ``pixels`` (M,), ascending flat indices into the reference, and no votes."""
    depth, normal, confidence = ref
    width, row = depth.shape[1], 0
    for t in range(len(tiles)):
        tile = tiles[t]
        for m in range(TILE_SIZE):
            tile[m] = 0.0
        for m in range(TILE):
            tile[Z + m], tile[SUPPORT + m], tile[COSINE + m] = np.nan, 1.0, 1.0
        for m in range(min(len(pixels) - t * TILE, TILE)):
            pixel = pixels[t * TILE + m]
            if pixel >= (row + 1) * width:
                row = pixel // width
            col = pixel - row * width
            tile[ROW + m], tile[COL + m] = row, col
            for channel in range(3):
                tile[NX + channel * TILE + m] = normal[row, col, channel]
            tile[Z + m], tile[CONFIDENCE + m] = depth[row, col], confidence[row, col]


@njit(cache=True, error_model="numpy")
def _locate(tile: NDArray[np.float32], w: Scratch, pair: Pair, width: int, height: int) -> int:
    """Where the pixels of a tile lie in the other view; returns how many it contains."""
    cx, cy, ifx, ify = pair[2], pair[3], pair[4], pair[5]
    fu, fv, cu, cv = pair[6], pair[7], pair[8], pair[9]
    a0, a1, a2, a3, b0, b1 = pair[12], pair[13], pair[14], pair[15], pair[16], pair[17]
    b2, b3, c0, c1, c2, c3 = pair[18], pair[19], pair[20], pair[21], pair[22], pair[23]
    right, bottom, found = np.float32(width), np.float32(height), 0
    for m in range(TILE):
        z = tile[Z + m]
        x = (tile[COL + m] + _HALF - cx) * ifx * z
        y = (tile[ROW + m] + _HALF - cy) * ify * z
        depth = c0 * x + c1 * y + c2 * z + c3
        inverse = _1 / depth
        there_x = (a0 * x + a1 * y + a2 * z + a3) * inverse
        there_y = (b0 * x + b1 * y + b2 * z + b3) * inverse
        u, v = fu * there_x + cu, fv * there_y + cv
        inside = (depth > _0) & (u >= _0) & (u < right) & (v >= _0) & (v < bottom)
        i, j = np.floor(u), np.floor(v)
        w[_X + m], w[_Y + m], w[_DEPTH + m], w[_I + m], w[_J + m] = there_x, there_y, depth, i, j
        w[_INSIDE + m] = _1 if inside else _0
        found += inside
    return found


@njit(cache=True, error_model="numpy")
def _fetch(w: Scratch, other: Surface) -> None:
    """Depth, normal and confidence of the other view at the pixels of a tile."""
    depth, normal, confidence = other
    for m in range(TILE):
        if w[_INSIDE + m] == _0:
            w[_D + m] = _0
            continue
        row, col = np.uint32(w[_J + m]), np.uint32(w[_I + m])
        w[_D + m] = depth[row, col]
        w[_N + m] = normal[row, col, 0]
        w[_N + TILE + m] = normal[row, col, 1]
        w[_N + 2 * TILE + m] = normal[row, col, 2]
        w[_C + m] = confidence[row, col]


@njit(cache=True, error_model="numpy")
def _compare(tile: NDArray[np.float32], w: Scratch, pair: Pair) -> None:
    """What differs between the pixels of a tile and the surface of the other view there.

    The depth along the ray is that of the tangent plane of the other pixel: exact on planes at every
    sub-pixel position, and one memory access; no value is interpolated across a discontinuity. A plane
    that is nearly parallel to the ray says nothing about depth, so beyond a ratio of ``_MOST_TILT`` the
    depth of the pixel stands as it is.
    """
    fx, fy, cx, cy, ifx, ify = pair[0], pair[1], pair[2], pair[3], pair[4], pair[5]
    cu, cv, ifu, ifv = pair[8], pair[9], pair[10], pair[11]
    a0, a1, a2, b0, b1, b2 = pair[12], pair[13], pair[14], pair[16], pair[17], pair[18]
    c0, c1, c2 = pair[20], pair[21], pair[22]
    for m in range(TILE):
        nx, ny, nz = w[_N + m], w[_N + TILE + m], w[_N + 2 * TILE + m]
        x, y, depth = w[_X + m], w[_Y + m], w[_DEPTH + m]
        centre_x, centre_y = (w[_I + m] + _HALF - cu) * ifu, (w[_J + m] + _HALF - cv) * ifv
        ratio = (nx * centre_x + ny * centre_y + nz) / (nx * x + ny * y + nz)
        flat = (ratio > _FLATTEST) & (ratio < _STEEPEST)
        error = w[_D + m] * (ratio if flat else _1) - depth
        dx = a0 * (x * error) + b0 * (y * error) + c0 * error
        dy = a1 * (x * error) + b1 * (y * error) + c1 * error
        dz = a2 * (x * error) + b2 * (y * error) + c2 * error
        z = tile[Z + m]
        here_x, here_y = (tile[COL + m] + _HALF - cx) * ifx, (tile[ROW + m] + _HALF - cy) * ify
        inverse = _1 / (z + dz)
        # (here · z + d) / (z + dz) − here, without the cancellation.
        du, dv = fx * ((dx - here_x * dz) * inverse), fy * ((dy - here_y * dz) * inverse)
        w[_BACK + m] = du * du + dv * dv if inverse > _0 else _INFINITE
        w[_ERROR + m] = error * (_1 / depth)
        tx, ty, tz = a0 * nx + b0 * ny + c0 * nz, a1 * nx + b1 * ny + c1 * nz, a2 * nx + b2 * ny + c2 * nz
        w[_AGREE + m] = tx * tile[NX + m] + ty * tile[NY + m] + tz * tile[NZ + m]
        w[_TURNED + m], w[_TURNED + TILE + m], w[_TURNED + 2 * TILE + m] = tx, ty, tz


@njit(cache=True, error_model="numpy")
def _allow(tile: NDArray[np.float32], w: Scratch, limits: Limits) -> None:
    """The relative depth errors allowed between the pixels of a tile and those of the other view."""
    depth_error, sigma_at_one = np.float32(limits[0]), np.float32(limits[3])
    most = max(depth_error, np.float32(limits[4]))
    for m in range(TILE):
        w[_LIMIT + m] = depth_error
    if sigma_at_one <= _0:
        return
    for m in range(TILE):
        one, other = tile[CONFIDENCE + m], w[_C + m]
        sigma = sigma_at_one * np.sqrt(_1 / (one * one) + _1 / (other * other))
        w[_LIMIT + m] = min(max(depth_error, sigma), most)


@njit(cache=True, error_model="numpy")
def _judge(w: Scratch, limits: Limits) -> None:
    """The outcomes of the comparisons of a tile."""
    reproj, cosine = np.float32(limits[1] * limits[1]), np.float32(limits[2])
    unseen, hole, occluded, through = (
        np.float32(UNSEEN),
        np.float32(HOLE),
        np.float32(OCCLUDED),
        np.float32(THROUGH),
    )
    depth, reprojection, normal, agrees = (
        np.float32(DEPTH), np.float32(REPROJECTION), np.float32(NORMAL), np.float32(AGREES)
    )  # fmt: skip
    three = np.float32(3.0)
    for m in range(TILE):
        off = w[_ERROR + m] / w[_LIMIT + m]
        outcome = agrees if w[_AGREE + m] >= cosine else normal
        outcome = outcome if w[_BACK + m] <= reproj else reprojection
        apart = through if off > _0 else occluded
        apart = depth if abs(off) <= three else apart
        outcome = outcome if abs(off) <= _1 else apart
        outcome = outcome if w[_D + m] > _0 else hole
        w[_OUTCOME + m] = outcome if w[_INSIDE + m] > _0 else unseen


@njit(cache=True, error_model="numpy")
def _add(tile: NDArray[np.float32], w: Scratch, votes: NDArray[np.float32]) -> None:
    """Count the votes of the other view on a tile, and note them in its ``votes`` (VOTE_SIZE,)."""
    unseen, through, agree = np.float32(UNSEEN), np.float32(THROUGH), np.float32(AGREES)
    for m in range(TILE):
        outcome = w[_OUTCOME + m]
        tile[SEEN + m] += _1 if outcome > unseen else _0
        tile[SUPPORT + m] += _1 if outcome == agree else _0
        tile[CONFLICTS + m] += _1 if outcome == through else _0
    for m in range(TILE):
        agrees = w[_OUTCOME + m] == agree
        votes[WEIGHT + m] = w[_C + m] if agrees else _0
        votes[OFF + m] = w[_ERROR + m] if agrees else _0
        votes[TURNED + m] = w[_TURNED + m] if agrees else _0
        votes[TURNED + TILE + m] = w[_TURNED + TILE + m] if agrees else _0
        votes[TURNED + 2 * TILE + m] = w[_TURNED + 2 * TILE + m] if agrees else _0


@njit(cache=True, error_model="numpy")
def _widen(tile: NDArray[np.float32], w: Scratch, pair: Pair) -> None:
    """Note the angle at each point of a tile between its camera and the other, where they agree."""
    cx, cy, ifx, ify = pair[2], pair[3], pair[4], pair[5]
    there_x = -(pair[12] * pair[15] + pair[16] * pair[19] + pair[20] * pair[23])
    there_y = -(pair[13] * pair[15] + pair[17] * pair[19] + pair[21] * pair[23])
    there_z = -(pair[14] * pair[15] + pair[18] * pair[19] + pair[22] * pair[23])
    agree = np.float32(AGREES)
    for m in range(TILE):
        x, y = (tile[COL + m] + _HALF - cx) * ifx, (tile[ROW + m] + _HALF - cy) * ify
        z, before = tile[Z + m], tile[COSINE + m]
        a, b, c = x * z - there_x, y * z - there_y, z - there_z
        cosine = (x * a + y * b + c) / np.sqrt((x * x + y * y + _1) * (a * a + b * b + c * c))
        tile[COSINE + m] = cosine if (w[_OUTCOME + m] == agree) & (cosine < before) else before


@njit(cache=True, error_model="numpy", nogil=True)
def vote(
    tiles: Tiles,
    votes: Votes,
    other: Surface,
    pair: Pair,
    limits: Limits,
    slot: int,
    who: NDArray[np.uint64],
    failed: NDArray[np.int64],
) -> None:
    """Let one neighbour vote on the pixels of ``tiles``.

    Args:
        tiles: the votes are counted there.
        votes: and noted there.
        other: the neighbour.
        pair: the reference and it.
        limits: of what agrees.
        slot: its number.
        who: (words, pixels) gets its bit where it agrees.
        failed: (3,) counts the comparisons that failed by depth, reprojection and normal.
    """
    height, width = other[0].shape
    bits, bit, at = who[slot >> 6], np.uint64(1) << np.uint64(slot & 63), slot * VOTE_SIZE
    occluded, depth, reprojection = np.float32(OCCLUDED), np.float32(DEPTH), np.float32(REPROJECTION)
    normal, agrees = np.float32(NORMAL), np.float32(AGREES)
    w = np.ones(_SCRATCH, np.float32)
    for t in range(len(tiles)):
        tile = tiles[t]
        if _locate(tile, w, pair, width, height) == 0:
            votes[t, at : at + VOTE_SIZE] = 0.0
            continue
        _fetch(w, other)
        _compare(tile, w, pair)
        _allow(tile, w, limits)
        _judge(w, limits)
        _add(tile, w, votes[t, at : at + VOTE_SIZE])
        _widen(tile, w, pair)
        by_depth, by_reprojection, by_normal = np.int32(0), np.int32(0), np.int32(0)
        for m in range(TILE):
            outcome = w[_OUTCOME + m]
            by_depth += np.int32((outcome >= occluded) & (outcome <= depth))
            by_reprojection += np.int32(outcome == reprojection)
            by_normal += np.int32(outcome == normal)
        if by_depth + by_reprojection + by_normal < TILE:
            for m in range(TILE):
                bits[t * TILE + m] |= bit if w[_OUTCOME + m] == agrees else np.uint64(0)
        failed[0] += by_depth
        failed[1] += by_reprojection
        failed[2] += by_normal


@njit(cache=True, error_model="numpy", nogil=True)
def differences(tiles: Tiles, other: Surface, pair: Pair, out: NDArray[np.float64]) -> int:
    """Fill ``out`` (M, 3) with how much a neighbour differs at those pixels of ``tiles`` that it sees.

    The columns are the relative depth error, the reprojection error in pixels, and the angle between
    the normals in radians.

    Returns how many rows were filled.
    """
    (height, width), found = other[0].shape, 0
    w = np.ones(_SCRATCH, np.float32)
    for t in range(len(tiles)):
        _locate(tiles[t], w, pair, width, height)
        _fetch(w, other)
        _compare(tiles[t], w, pair)
        for m in range(TILE):
            if w[_D + m] > 0.0:
                out[found, 0] = abs(w[_ERROR + m])
                out[found, 1] = np.sqrt(w[_BACK + m])
                out[found, 2] = np.arccos(min(max(w[_AGREE + m], -1.0), 1.0))
                found += 1
    return found


@njit(cache=True, error_model="numpy", nogil=True)
def accept(
    tiles: Tiles,
    count: int,
    rules: tuple[float, float, float, float],
    kept: NDArray[np.int64],
    supports: NDArray[np.int64],
    removed: NDArray[np.int64],
) -> int:
    """List in ``kept`` (M,) the pixels of ``tiles``, by number, that have the support that they need.

    Args:
        tiles: of ``count`` pixels.
        count: M.
        rules: views wanted; the fewest that will do where no more see a pixel; conflicts allowed for a
            view of support, infinity for all; largest cosine of the widest angle.
        kept: is filled.
        supports: (M,) is filled with the views that agree on each.
        removed: (4,) counts pixels with too many conflicts, with too little support, seen within too
            narrow an angle, and kept ones with less than the wanted support.

    Returns:
        How many are kept.
    """
    wanted, fewest, conflicts_allowed, narrowest = rules
    found = 0
    for p in range(count):
        tile, m = tiles[p // TILE], p % TILE
        support = tile[SUPPORT + m]
        if tile[CONFLICTS + m] > conflicts_allowed * support:
            removed[0] += 1
        elif support < min(wanted, max(fewest, tile[SEEN + m] + 1.0)):
            removed[1] += 1
        elif support > 1.0 and tile[COSINE + m] > narrowest:
            removed[2] += 1
        else:
            removed[3] += support < wanted
            kept[found], supports[found] = p, np.int64(support)
            found += 1
    return found
