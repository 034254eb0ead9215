"""Where rays meet boxes, ellipsoids and cylinders, found through a tree of bounding boxes.

Compiled code is cached by file: after a change here, remove ``training/__pycache__``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

BOX, ELLIPSOID, CYLINDER, ROOM = 0, 1, 2, 3
"""Kinds of primitive. A room is a box seen from inside: rays hit where they leave it."""

Doubles = NDArray[np.float64]


class Tree(NamedTuple):
    """P primitives in a binary tree of N bounding boxes, in depth-first order.

    Few plain arrays of one type, since compiled functions pay for each array that they are handed.

    Attributes:
        nodes: (N, 9) lowest and highest corner; right child (the left one is the next node) or −1 for a
            leaf; a leaf's range in ``order``.
        order: (P,) primitives.
        shapes: (P, 13) unit_from_world matrix, what is subtracted after it, and the kind.
    """

    nodes: Doubles
    order: NDArray[np.int32]
    shapes: Doubles


def tree(kind: NDArray[np.int32], rotation: Doubles, centre: Doubles, half: Doubles) -> Tree:
    """The tree of primitives with object_from_world rotations, centres and half sizes, in the world."""
    turn, middle, size = (np.asarray(a, np.float64) for a in (rotation, centre, half))
    reach = np.einsum("pij,pi->pj", np.abs(turn), size) * (1 + 1e-6) + 1e-6
    matrix = turn / size[:, :, None]
    nodes, order = _build(middle - reach, middle + reach)
    shift = np.einsum("pij,pj->pi", matrix, middle)
    return Tree(nodes, order, np.concatenate([matrix.reshape(-1, 9), shift, kind[:, None]], 1))


@njit(cache=True)
def _area(box):  # type: ignore[no-untyped-def]
    """Half the surface of a box (6,)."""
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@njit(cache=True)
def _grow(box, low, high):  # type: ignore[no-untyped-def]
    """Make a box contain another."""
    for a in range(3):
        box[a] = min(box[a], low[a])
        box[3 + a] = max(box[3 + a], high[a])


@njit(cache=True)
def _split(low, high, part):  # type: ignore[no-untyped-def]
    """Best (axis, left count) by the surface area heuristic (MacDonald and Booth 1990); count 0 for none."""
    n = len(part)
    whole, box, after = np.empty(6), np.empty(6), np.empty(n)
    whole[:3], whole[3:] = 1e30, -1e30
    for p in part:
        _grow(whole, low[p], high[p])
    best, axis, left = n * _area(whole), 0, 0
    for a in range(3):
        by = part[np.argsort((low[:, a] + high[:, a])[part], kind="mergesort")]
        box[:3], box[3:] = 1e30, -1e30
        for i in range(n - 1, 0, -1):
            _grow(box, low[by[i]], high[by[i]])
            after[i] = (n - i) * _area(box)
        box[:3], box[3:] = 1e30, -1e30
        for i in range(1, n):
            _grow(box, low[by[i - 1]], high[by[i - 1]])
            cost = i * _area(box) + after[i] + 0.5 * _area(whole)
            if cost < best:
                best, axis, left = cost, a, i
    return axis, left


@njit(cache=True)
def _build(low, high):  # type: ignore[no-untyped-def]
    """Nodes and order, as in :class:`Tree`, over the boxes from ``low`` to ``high`` (P, 3)."""
    count = len(low)
    tree = np.empty((2 * count, 9))
    order = np.arange(count).astype(np.int32)
    todo = np.empty((2 * count + 2, 3), np.int32)
    todo[0], waiting, nodes = np.array([0, count, -1], np.int32), 1, 0
    while waiting > 0:
        waiting -= 1
        first, last, parent = todo[waiting, 0], todo[waiting, 1], todo[waiting, 2]
        node, nodes = nodes, nodes + 1
        if parent >= 0:
            tree[parent, 6] = node
        tree[node, :3], tree[node, 3:6], tree[node, 6] = 1e30, -1e30, -1
        for p in order[first:last]:
            _grow(tree[node], low[p], high[p])
        tree[node, 7], tree[node, 8] = first, last
        if last - first <= 1:
            continue
        part = order[first:last].copy()
        axis, left = _split(low, high, part)
        if left == 0:
            continue
        order[first:last] = part[np.argsort((low[:, axis] + high[:, axis])[part], kind="mergesort")]
        todo[waiting, 0], todo[waiting, 1], todo[waiting, 2] = first + left, last, node
        todo[waiting + 1, 0], todo[waiting + 1, 1], todo[waiting + 1, 2] = first, first + left, -1
        waiting += 2
    return tree[:nodes], order


@njit(cache=True, fastmath=True, nogil=True)
def _box(o, d, inside):  # type: ignore[no-untyped-def]
    """Entry (or exit, from inside) distance and face of the unit box; (1e30, 0) for a miss."""
    near, far, face_near, face_far = -1e30, 1e30, 0, 0
    for a in range(3):
        if abs(d[a]) < 1e-9:
            if abs(o[a]) > 1.0:
                return 1e30, 0
            continue
        t1, t2 = (-1.0 - o[a]) / d[a], (1.0 - o[a]) / d[a]
        f1, f2 = 2 * a, 2 * a + 1
        if t1 > t2:
            t1, t2, f1, f2 = t2, t1, f2, f1
        if t1 > near:
            near, face_near = t1, f1
        if t2 < far:
            far, face_far = t2, f2
    if near > far:
        return 1e30, 0
    if inside:
        return (far, face_far) if far > 1e-4 else (1e30, 0)
    return (near, face_near) if near > 1e-4 else (1e30, 0)


@njit(cache=True, fastmath=True, nogil=True)
def _quadric(o, d, cylinder):  # type: ignore[no-untyped-def]
    """First hit of the unit sphere, or of the unit cylinder along z with its caps (faces 4 and 5)."""
    n = 2 if cylinder else 3
    a = b = c = 0.0
    for i in range(n):
        a += d[i] * d[i]
        b += o[i] * d[i]
        c += o[i] * o[i]
    disc = b * b - a * (c - 1.0)
    best, face = 1e30, 0
    if disc > 0 and a > 1e-12:
        t = (-b - np.sqrt(disc)) / a
        if t > 1e-4 and (not cylinder or abs(o[2] + t * d[2]) <= 1.0):
            best = t
    if cylinder and abs(d[2]) > 1e-9:
        for side in range(2):
            t = ((2.0 * side - 1.0) - o[2]) / d[2]
            x, y = o[0] + t * d[0], o[1] + t * d[1]
            if 1e-4 < t < best and x * x + y * y <= 1.0:
                best, face = t, 4 + side
    return best, face


@njit(cache=True, fastmath=True, nogil=True)
def local(shapes, p, origin, way):  # type: ignore[no-untyped-def]
    """Ray in the frame in which primitive ``p`` is a unit one; the ray parameter is unchanged."""
    x, y, z = origin
    u, v, w = way
    o = (
        shapes[p, 0] * x + shapes[p, 1] * y + shapes[p, 2] * z - shapes[p, 9],
        shapes[p, 3] * x + shapes[p, 4] * y + shapes[p, 5] * z - shapes[p, 10],
        shapes[p, 6] * x + shapes[p, 7] * y + shapes[p, 8] * z - shapes[p, 11],
    )
    d = (
        shapes[p, 0] * u + shapes[p, 1] * v + shapes[p, 2] * w,
        shapes[p, 3] * u + shapes[p, 4] * v + shapes[p, 5] * w,
        shapes[p, 6] * u + shapes[p, 7] * v + shapes[p, 8] * w,
    )
    return o, d


@njit(cache=True, fastmath=True, nogil=True)
def one(shapes, p, origin, way):  # type: ignore[no-untyped-def]
    """Distance and face where a ray hits primitive ``p``; 1e30 for a miss."""
    o, d = local(shapes, p, origin, way)
    kind = shapes[p, 12]
    if kind == BOX or kind == ROOM:
        return _box(o, d, kind == ROOM)
    return _quadric(o, d, kind == CYLINDER)


@njit(cache=True, fastmath=True, nogil=True)
def _missed(nodes, node, origin, slope, far):  # type: ignore[no-untyped-def]
    """Whether a ray passes a node's box, or meets it only beyond ``far``."""
    near = 0.0
    for a in range(3):
        t1 = (nodes[node, a] - origin[a]) * slope[a]
        t2 = (nodes[node, 3 + a] - origin[a]) * slope[a]
        near, far = max(near, min(t1, t2)), min(far, max(t1, t2))
    return near > far


@njit(cache=True, fastmath=True, nogil=True)
def nearest(tree, origin, way, limit, any_solid, stack):  # type: ignore[no-untyped-def]
    """Distance, primitive and face of the first hit before ``limit``; primitive −1 for none.

    With ``any_solid``, the first one found that is not a room: enough for a shadow. ``stack`` (100,) int32
    is room to work in.
    """
    nodes, order, shapes = tree
    x, y, z = way
    slope = (
        1 / x if abs(x) > 1e-12 else 1e12,
        1 / y if abs(y) > 1e-12 else 1e12,
        1 / z if abs(z) > 1e-12 else 1e12,
    )
    best, hit, face = limit, -1, 0
    stack[0], waiting = 0, 1
    while waiting > 0:
        waiting -= 1
        node = stack[waiting]
        if _missed(nodes, node, origin, slope, best):
            continue
        if nodes[node, 6] >= 0:
            stack[waiting], stack[waiting + 1] = int(nodes[node, 6]), node + 1
            waiting += 2
            continue
        for k in range(int(nodes[node, 7]), int(nodes[node, 8])):
            p = order[k]
            if any_solid and shapes[p, 12] == ROOM:
                continue
            t, f = one(shapes, p, origin, way)
            if t < best:
                best, hit, face = t, p, f
                if any_solid:
                    return best, hit, face
    return best, hit, face
