"""fused.ply and fused.ply.vis: layout byte by byte, round trips, damaged files, Open3D as a reader."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from colmap_tco.errors import InputError
from colmap_tco.ply import (
    Cloud,
    Visibility,
    join,
    needs_double,
    read_ply,
    read_vis,
    write_ply,
    write_ply_blocks,
    write_vis,
)
from tests.programs import imported_open3d


def random_cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (
        rng.standard_normal((count, 3)),
        normals.astype(np.float32),
        rng.integers(0, 256, (count, 3), np.uint8),
    )


def lists(*images):
    start = np.cumsum([0, *(len(i) for i in images)])
    return Visibility(start, np.array([j for i in images for j in i], np.uint32))


def traced(function: Callable[[], object]) -> int:
    """Most bytes that were allocated at once while a function ran."""
    tracemalloc.start()
    try:
        function()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def parts(count: int, size: int) -> Iterator[Cloud]:
    """Clouds of ``size`` points, each seen by five images, that nobody else holds."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield Cloud(
            rng.normal(size=(size, 3)),
            np.ones((size, 3), np.float32),
            np.zeros((size, 3), np.uint8),
            Visibility(5 * np.arange(size + 1), np.arange(5 * size, dtype=np.uint32)),
        )


def test_joining_needs_the_memory_of_the_cloud_and_of_its_largest_array() -> None:
    """24 of 67 bytes; both copies at once would be twice the cloud."""
    whole = 20 * 10_000 * (47 + 4 * 5) + 8
    assert join(parts(20, 10_000)).nbytes == whole
    assert traced(lambda: join(parts(20, 10_000))) < 1.45 * whole


def test_writing_needs_the_memory_of_a_block(tmp_path: Path) -> None:
    size = 800_000
    points, colors = np.zeros((size, 3)), np.zeros((size, 3), np.uint8)
    normals = np.zeros((size, 3), np.float32)
    peak = traced(lambda: write_ply(tmp_path / "c.ply", points, normals, colors))
    assert (tmp_path / "c.ply").stat().st_size > 27 * size
    assert peak < 0.5 * 27 * size


def test_layout():
    assert struct.calcsize("<6f3B") == 27


def test_bytes_of_one_point(tmp_path):
    write_ply(
        tmp_path / "c.ply", np.array([[1.0, 2, 3]]), np.array([[0.0, 0, -1]]), np.array([[7, 8, 9]], np.uint8)
    )
    head, body = (tmp_path / "c.ply").read_bytes().split(b"end_header\n")
    assert body == struct.pack("<6f3B", 1, 2, 3, 0, 0, -1, 7, 8, 9)
    assert head.decode().splitlines()[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    assert head.decode().splitlines()[3:] == [
        f"property float {n}" for n in ("x", "y", "z", "nx", "ny", "nz")
    ] + [f"property uchar {n}" for n in ("red", "green", "blue")]


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip(tmp_path, count):
    points, normals, colors = random_cloud(count)
    write_ply(tmp_path / "new" / "c.ply", points, normals, colors)
    p, n, c = read_ply(tmp_path / "new" / "c.ply")
    assert np.array_equal(p, points.astype(np.float32))
    assert np.array_equal(n, normals)
    assert np.array_equal(c, colors)
    assert len(list((tmp_path / "new").iterdir())) == 1


def test_double_coordinates_keep_every_bit(tmp_path):
    points, normals, colors = random_cloud(50)
    points = points.astype(np.float64) + (5e5, 5.4e6, 300)
    write_ply(tmp_path / "a.ply", points, normals, colors, double=True)
    back = read_ply(tmp_path / "a.ply")
    for written, read in zip((points, normals.astype(np.float32), colors), back, strict=True):
        assert np.array_equal(written, read)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    assert b"property double z\nproperty float nx" in header
    assert len(body) == 50 * 39
    o3d = imported_open3d()
    assert np.array_equal(np.asarray(o3d.io.read_point_cloud(str(tmp_path / "a.ply")).points), points)


@pytest.mark.parametrize(
    ("origin", "extent", "count", "double"),
    [(0, 1, 10**4, False), (0, 10**6, 10**4, False), (100, 30, 10**4, False), (5e6, 100, 10**4, True),
     (5e5, 100, 10**4, True), (5e6, 5e5, 100, False), (5e6, 0, 100, False), (5e6, 100, 1, False),
     (5e6, 100, 0, False)],
)  # fmt: skip
def test_doubles_are_taken_where_float32_would_round_the_spacing(origin, extent, count, double):
    """A sheet of extent² with so many points: spacing extent / √count, rounding origin · 2⁻²⁴."""
    points = np.random.default_rng(0).uniform(0, 1, (count, 3)) * (extent, extent, 0) + origin
    assert needs_double(points) == double


def test_blocks_make_the_same_bytes_as_one(tmp_path):
    cloud = random_cloud(100)
    write_ply(tmp_path / "one.ply", *cloud)
    cuts = (0, 1, 1, 64, 100)
    blocks = (tuple(a[i:j] for a in cloud) for i, j in pairwise(cuts))
    total = write_ply_blocks(tmp_path / "many.ply", blocks)
    assert total == 100
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "many.ply").read_bytes()


def test_an_exception_between_blocks_leaves_the_old_file(tmp_path):
    write_ply(tmp_path / "c.ply", *random_cloud(3))
    before = (tmp_path / "c.ply").read_bytes()

    def blocks():
        yield random_cloud(5)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_ply_blocks(tmp_path / "c.ply", blocks())
    assert (tmp_path / "c.ply").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p, n, c: (p[:-1], n, c), "differ"),
        (lambda p, n, c: (p, n, c.astype(float)), "uint8"),
        (lambda p, n, c: (p * np.nan, n, c), "not finite"),
    ],
)
def test_refuses(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        write_ply(tmp_path / "c.ply", *change(*random_cloud(4)))


def test_reads_other_orders_and_precisions(tmp_path):
    data = np.zeros(2, [("red", "u1"), ("x", "<f8"), ("y", "<f8"), ("z", "<f8")])
    data["red"], data["x"] = [3, 4], [1e6 + 0.125, 2]
    (tmp_path / "c.ply").write_bytes(
        b"ply\nformat binary_little_endian 1.0\ncomment x\nelement vertex 2\nproperty uchar red\n"
        b"property double x\nproperty double y\nproperty float64 z\nelement face 0\n"
        b"property list uchar int vertex_indices\nend_header\n" + data.tobytes()
    )
    points, normals, colors = read_ply(tmp_path / "c.ply")
    assert points[0, 0] == 1e6 + 0.125
    assert colors[:, 0].tolist() == [3, 4] and not colors[:, 1:].any() and not normals.any()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "binary"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n",
            "x, y, z",
        ),
        (b"ply\nformat binary_little_endian 1.0\nelement face 1\nend_header\n", "first element"),
    ],
)
def test_damaged_ply_is_an_error(tmp_path, content, message):
    (tmp_path / "c.ply").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_ply(tmp_path / "c.ply")


def test_truncated_ply_is_an_error(tmp_path):
    write_ply(tmp_path / "c.ply", *random_cloud(4))
    data = (tmp_path / "c.ply").read_bytes()
    (tmp_path / "c.ply").write_bytes(data[:-1])
    with pytest.raises(InputError, match="truncated"):
        read_ply(tmp_path / "c.ply")


@pytest.mark.parametrize("images", [(), ((0, 3),), ((5,), (), (1, 2, 3), ())])
def test_visibility_round_trip(tmp_path, images):
    write_vis(tmp_path / "c.vis", lists(*images))
    back = read_vis(tmp_path / "c.vis")
    assert [back[i].tolist() for i in range(len(back))] == [list(i) for i in images]
    flat = [len(images), 0]
    for seen in images:
        flat += [len(seen), *seen]
    assert np.frombuffer((tmp_path / "c.vis").read_bytes(), "<u4").tolist() == flat


def walked(words: np.ndarray) -> list[int]:
    """Where lists that follow one another begin, one after the other."""
    heads, at = [], 0
    while at < len(words):
        heads.append(at)
        at += 1 + int(words[at])
    return heads


@pytest.mark.parametrize("longest", [0, 1, 3, 20, 300])
@pytest.mark.parametrize("points", [1, 2, 99, 2000])
def test_lists_of_all_lengths_are_read_as_one_after_the_other(tmp_path, points, longest):
    """Images are as small as counts are, so that a wrong step would go on as a plausible walk."""
    rng = np.random.default_rng(points + longest)
    count = rng.integers(0, longest + 1, points)
    images = rng.integers(0, max(longest, 1), count.sum()).astype(np.uint32)
    visibility = Visibility(np.concatenate([[0], count.cumsum()]), images)
    write_vis(tmp_path / "c.vis", visibility)
    back = read_vis(tmp_path / "c.vis")
    words = np.frombuffer((tmp_path / "c.vis").read_bytes(), "<u4", offset=8)
    heads = walked(words)
    assert np.diff(back.start).tolist() == words[heads].tolist() == count.tolist()
    assert np.array_equal(back.images, images)


@pytest.mark.parametrize("points", [0, 1, 3, 2**60])
def test_a_wrong_number_of_points_is_an_error(tmp_path, points):
    write_vis(tmp_path / "c.vis", lists((1, 2), (3,)))
    data = (tmp_path / "c.vis").read_bytes()
    (tmp_path / "c.vis").write_bytes(np.uint64(points).tobytes() + data[8:])
    with pytest.raises(InputError, match="damaged"):
        read_vis(tmp_path / "c.vis")


@pytest.mark.parametrize("cut", [4, 8, 1])
def test_truncated_visibility_is_an_error(tmp_path, cut):
    write_vis(tmp_path / "c.vis", lists((1, 2), (3,)))
    data = (tmp_path / "c.vis").read_bytes()
    (tmp_path / "c.vis").write_bytes(data[:-cut])
    with pytest.raises(InputError):
        read_vis(tmp_path / "c.vis")


def test_join_concatenates_points_and_lists():
    a = Cloud(*random_cloud(2, 1), lists((0, 1), (2,)))
    b = Cloud(*random_cloud(1, 2), lists((3, 4, 5)))
    both = join([a, b])
    assert len(both) == 3
    assert [both.visibility[i].tolist() for i in range(3)] == [[0, 1], [2], [3, 4, 5]]
    assert np.array_equal(both.points[2], b.points[0])
    assert len(join([])) == 0


def test_open3d_reads_points_normals_and_colours(tmp_path):
    o3d = imported_open3d()
    points, normals, colors = random_cloud(50)
    write_ply(tmp_path / "c.ply", points, normals, colors)
    theirs = o3d.io.read_point_cloud(str(tmp_path / "c.ply"))
    assert np.allclose(np.asarray(theirs.points), points, atol=1e-6)
    assert np.allclose(np.asarray(theirs.normals), normals, atol=1e-6)
    assert np.array_equal(np.rint(np.asarray(theirs.colors) * 255).astype(np.uint8), colors)
