"""Compiled loops of :mod:`colmap_tco.fusion`: which views agree on the pixels of a reference.

The pixels are taken in tiles, and each step is a plain loop over a tile without branches and calls,
which the compiler turns into vector instructions; only the reading of the other view's pixels is one
by one. That takes a third of the time of one loop over all steps. Each tile's numbers are rows of one
array, one after the other, since the compiler gives up where it would have to prove of many arrays
that they do not overlap. All arithmetic is in double precision.
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
_X, _Y, _DEPTH, _I, _J, _AT = range(0, 6 * TILE, TILE)
"""The point in the other view: ray, depth, column and row of the pixel, its flat index or −1."""
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

Tiles = NDArray[np.float32]
Votes = NDArray[np.float32]
Scratch = NDArray[np.float64]


def tiles_of(count: int) -> Tiles:
    """Room for so many pixels."""
    return np.empty((-(-count // TILE), TILE_SIZE), np.float32)


def votes_of(count: int, neighbours: int) -> Votes:
    """Room for the votes of so many neighbours on so many pixels."""
    return np.empty((-(-count // TILE), neighbours * VOTE_SIZE), np.float32)


@njit(cache=True, error_model="numpy", nogil=True)
def begin(ref: NDArray[np.float32], pixels: NDArray[np.int64], tiles: Tiles) -> None:
    """Fill ``tiles`` with ``pixels`` (M,), ascending flat indices into the packed view, and no votes."""
    width, row = ref.shape[1], 0
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
                tile[NX + channel * TILE + m] = ref[row, col, 1 + channel]
            tile[Z + m], tile[CONFIDENCE + m] = ref[row, col, 0], ref[row, col, 4]


@njit(cache=True, error_model="numpy")
def _locate(tile: NDArray[np.float32], w: Scratch, pair: NDArray[np.float64], width: int, height: int) -> int:
    """Where the pixels of a tile lie in the other view; returns how many it contains."""
    cx, cy, ifx, ify = pair[2], pair[3], pair[4], pair[5]
    fu, fv, cu, cv = pair[6], pair[7], pair[8], pair[9]
    a0, a1, a2, a3, b0, b1 = pair[12], pair[13], pair[14], pair[15], pair[16], pair[17]
    b2, b3, c0, c1, c2, c3 = pair[18], pair[19], pair[20], pair[21], pair[22], pair[23]
    right, bottom, found = float(width), float(height), 0
    for m in range(TILE):
        z = float(tile[Z + m])
        x = (float(tile[COL + m]) + 0.5 - cx) * ifx * z
        y = (float(tile[ROW + m]) + 0.5 - cy) * ify * z
        depth = c0 * x + c1 * y + c2 * z + c3
        inverse = 1.0 / depth
        there_x = (a0 * x + a1 * y + a2 * z + a3) * inverse
        there_y = (b0 * x + b1 * y + b2 * z + b3) * inverse
        u, v = fu * there_x + cu, fv * there_y + cv
        inside = (depth > 0.0) & (u >= 0.0) & (u < right) & (v >= 0.0) & (v < bottom)
        i, j = np.floor(u), np.floor(v)
        w[_X + m], w[_Y + m], w[_DEPTH + m], w[_I + m], w[_J + m] = there_x, there_y, depth, i, j
        w[_AT + m] = j * right + i if inside else -1.0
        found += inside
    return found


@njit(cache=True, error_model="numpy")
def _fetch(w: Scratch, pixels: NDArray[np.float32]) -> None:
    """Depth, normal and confidence of the other view, (H W, 5), at the pixels of a tile."""
    for m in range(TILE):
        at = np.int64(w[_AT + m])
        if at < 0:
            w[_D + m] = 0.0
            continue
        w[_D + m] = pixels[at, 0]
        w[_N + m] = pixels[at, 1]
        w[_N + TILE + m] = pixels[at, 2]
        w[_N + 2 * TILE + m] = pixels[at, 3]
        w[_C + m] = pixels[at, 4]


@njit(cache=True, error_model="numpy")
def _compare(tile: NDArray[np.float32], w: Scratch, pair: NDArray[np.float64]) -> None:
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
        centre_x, centre_y = (w[_I + m] + 0.5 - cu) * ifu, (w[_J + m] + 0.5 - cv) * ifv
        ratio = (nx * centre_x + ny * centre_y + nz) / (nx * x + ny * y + nz)
        flat = (ratio > 1.0 / _MOST_TILT) & (ratio < _MOST_TILT)
        error = w[_D + m] * (ratio if flat else 1.0) - depth
        dx = a0 * (x * error) + b0 * (y * error) + c0 * error
        dy = a1 * (x * error) + b1 * (y * error) + c1 * error
        dz = a2 * (x * error) + b2 * (y * error) + c2 * error
        z = float(tile[Z + m])
        here_x, here_y = (float(tile[COL + m]) + 0.5 - cx) * ifx, (float(tile[ROW + m]) + 0.5 - cy) * ify
        inverse = 1.0 / (z + dz)
        du = fx * ((here_x * z + dx) * inverse - here_x)
        dv = fy * ((here_y * z + dy) * inverse - here_y)
        w[_BACK + m] = du * du + dv * dv if inverse > 0.0 else np.inf
        w[_ERROR + m] = error * (1.0 / depth)
        tx, ty, tz = a0 * nx + b0 * ny + c0 * nz, a1 * nx + b1 * ny + c1 * nz, a2 * nx + b2 * ny + c2 * nz
        w[_AGREE + m] = tx * tile[NX + m] + ty * tile[NY + m] + tz * tile[NZ + m]
        w[_TURNED + m], w[_TURNED + TILE + m], w[_TURNED + 2 * TILE + m] = tx, ty, tz


@njit(cache=True, error_model="numpy")
def _allow(tile: NDArray[np.float32], w: Scratch, limits: Limits) -> None:
    """The relative depth errors allowed between the pixels of a tile and those of the other view."""
    depth_error, _, _, sigma_at_one, most_depth_error = limits
    for m in range(TILE):
        w[_LIMIT + m] = depth_error
    if sigma_at_one <= 0.0:
        return
    for m in range(TILE):
        one, other = float(tile[CONFIDENCE + m]), w[_C + m]
        sigma = sigma_at_one * np.sqrt(1.0 / (one * one) + 1.0 / (other * other))
        w[_LIMIT + m] = min(max(depth_error, sigma), max(depth_error, most_depth_error))


@njit(cache=True, error_model="numpy")
def _judge(w: Scratch, limits: Limits) -> None:
    """The outcomes of the comparisons of a tile."""
    reproj, cosine = limits[1] * limits[1], limits[2]
    for m in range(TILE):
        off = w[_ERROR + m] / w[_LIMIT + m]
        outcome = 7.0 if w[_AGREE + m] >= cosine else 6.0
        outcome = outcome if w[_BACK + m] <= reproj else 5.0
        apart = 3.0 if off > 0.0 else 2.0
        apart = 4.0 if abs(off) <= 3.0 else apart
        outcome = outcome if abs(off) <= 1.0 else apart
        outcome = outcome if w[_D + m] > 0.0 else 1.0
        w[_OUTCOME + m] = outcome if w[_AT + m] >= 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _add(tile: NDArray[np.float32], w: Scratch, votes: NDArray[np.float32], at: int) -> None:
    """Count the votes of the other view on a tile, and note them in ``votes`` from ``at`` on."""
    for m in range(TILE):
        agrees = w[_OUTCOME + m] == AGREES
        tile[SEEN + m] += np.float32(w[_OUTCOME + m] > UNSEEN)
        tile[SUPPORT + m] += np.float32(agrees)
        tile[CONFLICTS + m] += np.float32(w[_OUTCOME + m] == THROUGH)
    for m in range(TILE):
        agrees = w[_OUTCOME + m] == AGREES
        votes[at + WEIGHT + m] = w[_C + m] if agrees else 0.0
        votes[at + OFF + m] = w[_ERROR + m] if agrees else 0.0
        votes[at + TURNED + m] = w[_TURNED + m] if agrees else 0.0
        votes[at + TURNED + TILE + m] = w[_TURNED + TILE + m] if agrees else 0.0
        votes[at + TURNED + 2 * TILE + m] = w[_TURNED + 2 * TILE + m] if agrees else 0.0


@njit(cache=True, error_model="numpy")
def _widen(tile: NDArray[np.float32], w: Scratch, pair: NDArray[np.float64]) -> None:
    """Note the angle at each point of a tile between its camera and the other, where they agree."""
    cx, cy, ifx, ify = pair[2], pair[3], pair[4], pair[5]
    there_x = -(pair[12] * pair[15] + pair[16] * pair[19] + pair[20] * pair[23])
    there_y = -(pair[13] * pair[15] + pair[17] * pair[19] + pair[21] * pair[23])
    there_z = -(pair[14] * pair[15] + pair[18] * pair[19] + pair[22] * pair[23])
    for m in range(TILE):
        x, y = (float(tile[COL + m]) + 0.5 - cx) * ifx, (float(tile[ROW + m]) + 0.5 - cy) * ify
        z, before = float(tile[Z + m]), tile[COSINE + m]
        a, b, c = x * z - there_x, y * z - there_y, z - there_z
        cosine = (x * a + y * b + c) / np.sqrt((x * x + y * y + 1.0) * (a * a + b * b + c * c))
        tile[COSINE + m] = cosine if (w[_OUTCOME + m] == AGREES) & (cosine < before) else before


@njit(cache=True, error_model="numpy", nogil=True)
def vote(
    tiles: Tiles,
    votes: Votes,
    other: NDArray[np.float32],
    pair: NDArray[np.float64],
    limits: Limits,
    slot: int,
    who: NDArray[np.uint64],
    failed: NDArray[np.int64],
) -> None:
    """Let one neighbour vote on the pixels of ``tiles``.

    Args:
        tiles: the votes are counted there.
        votes: and noted there.
        other: (H, W, 5) the neighbour.
        pair: the reference and it.
        limits: of what agrees.
        slot: its number.
        who: (words, pixels) gets its bit where it agrees.
        failed: (3,) counts the comparisons that failed by depth, reprojection and normal.
    """
    height, width = other.shape[0], other.shape[1]
    pixels = other.reshape(height * width, other.shape[2])
    bits, bit, at = who[slot >> 6], np.uint64(1) << np.uint64(slot & 63), slot * VOTE_SIZE
    w = np.ones(_SCRATCH)
    for t in range(len(tiles)):
        tile = tiles[t]
        if _locate(tile, w, pair, width, height) == 0:
            votes[t, at : at + VOTE_SIZE] = 0.0
            continue
        _fetch(w, pixels)
        _compare(tile, w, pair)
        _allow(tile, w, limits)
        _judge(w, limits)
        _add(tile, w, votes[t], at)
        _widen(tile, w, pair)
        by_depth, by_reprojection, by_normal = 0, 0, 0
        for m in range(TILE):
            outcome = w[_OUTCOME + m]
            by_depth += (outcome >= OCCLUDED) & (outcome <= DEPTH)
            by_reprojection += outcome == REPROJECTION
            by_normal += outcome == NORMAL
            bits[t * TILE + m] |= bit if outcome == AGREES else np.uint64(0)
        failed[0] += by_depth
        failed[1] += by_reprojection
        failed[2] += by_normal


@njit(cache=True, error_model="numpy", nogil=True)
def differences(
    tiles: Tiles, other: NDArray[np.float32], pair: NDArray[np.float64], out: NDArray[np.float64]
) -> int:
    """Fill ``out`` (M, 3) with how much a neighbour differs at those pixels of ``tiles`` that it sees.

    The columns are the relative depth error, the reprojection error in pixels, and the angle between
    the normals in radians.

    Returns how many rows were filled.
    """
    height, width, found = other.shape[0], other.shape[1], 0
    pixels = other.reshape(height * width, other.shape[2])
    w = np.ones(_SCRATCH)
    for t in range(len(tiles)):
        _locate(tiles[t], w, pair, width, height)
        _fetch(w, pixels)
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
