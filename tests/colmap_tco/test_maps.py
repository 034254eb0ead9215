"""The bytes of COLMAP's maps: round trips, pycolmap as an independent reader, damaged files."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_tco.errors import InputError
from colmap_tco.maps import map_shape, read_map, write_map


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (7, 2, 3), (4, 6, 1)])
def test_round_trip(tmp_path, shape):
    values = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    path = tmp_path / "deep" / "er" / "a.jpg.geometric.bin"
    write_map(path, values)
    back = read_map(path)
    assert np.array_equal(back, values.reshape(back.shape))
    assert map_shape(path) == (*shape[:2], shape[2] if len(shape) == 3 else 1)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_layout_is_planar_row_major(tmp_path):
    values = np.arange(2 * 3 * 2, dtype=np.float32).reshape(2, 3, 2)
    write_map(tmp_path / "m", values)
    data = (tmp_path / "m").read_bytes()
    assert data.startswith(b"3&2&2&")
    flat = np.frombuffer(data[6:], "<f4")
    for (row, col, channel), value in np.ndenumerate(values):
        assert flat[channel * 6 + row * 3 + col] == value


def test_pycolmap_reads_depth(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    depth = np.random.default_rng(1).uniform(1, 2, (4, 7)).astype(np.float32)
    write_map(tmp_path / "d", depth)
    theirs = pycolmap.DepthMap()
    theirs.read(str(tmp_path / "d"))
    assert np.array_equal(theirs.to_array(), depth)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_refuses_values_that_are_not_finite_and_keeps_the_old_file(tmp_path, bad):
    write_map(tmp_path / "d", np.ones((2, 2)))
    with pytest.raises(ValueError, match="not finite"):
        write_map(tmp_path / "d", np.array([[1.0, bad], [1.0, 1.0]]))
    assert np.array_equal(read_map(tmp_path / "d"), np.ones((2, 2)))


@pytest.mark.parametrize("shape", [(3,), (0, 4), (1, 2, 3, 4)])
def test_refuses_other_shapes(tmp_path, shape):
    with pytest.raises(ValueError, match="a map is"):
        write_map(tmp_path / "d", np.zeros(shape))


@pytest.mark.parametrize("cut", [1, 4, 30])
def test_truncated_file_is_an_error(tmp_path, cut):
    write_map(tmp_path / "d", np.ones((4, 4)))
    data = (tmp_path / "d").read_bytes()
    (tmp_path / "d").write_bytes(data[:-cut])
    with pytest.raises(InputError, match="damaged"):
        read_map(tmp_path / "d")


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"4&4&", b"4&-4&1&" + bytes(64), b"0&4&1&", b"4.0&4&1&" + bytes(64)]
)
def test_other_files_are_an_error(tmp_path, content):
    (tmp_path / "d").write_bytes(content)
    with pytest.raises(InputError, match="not a COLMAP map"):
        read_map(tmp_path / "d")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        read_map(tmp_path / "nowhere")
