"""Points between pictures whose cameras are known, by COLMAP, from the pictures alone."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_tco import _pycolmap
from colmap_tco._pycolmap import Floats
from colmap_tco.errors import InputError
from colmap_tco.pinhole import Pinhole
from colmap_tco.sparse_format import SparseImage, SparseModel, SparsePoints, write_binary

_PINHOLE = 1
"""COLMAP's number of the camera model."""


@dataclass(frozen=True)
class Picture:
    """A picture and its camera.

    Attributes:
        name: of the file.
        camera: of the picture as it is stored.
        cam_from_world: (3, 4).
    """

    name: str
    camera: Pinhole
    cam_from_world: Floats


def triangulate(root: Path, pictures: Sequence[Picture], seed: int, threads: int = -1) -> None:
    """Make a COLMAP workspace of ``root``, whose folder images/ holds the pictures.

    SIFT features are matched between all pairs and triangulated with the given cameras, which stay as they
    are. Writes database.db and sparse/0.

    Raises:
        InputError: no point is seen by two pictures.
    """
    database, images, output = root / "database.db", root / "images", root / "sparse" / "0"
    names = [picture.name for picture in pictures]
    _pycolmap.extract_features(database, images, names, share_camera=False, threads=threads, seed=seed)
    ids = _set_cameras(database, pictures)
    _pycolmap.match(database, threads, seed)
    known = root / "known"
    write_binary(known, _posed(pictures, ids))
    output.mkdir(parents=True, exist_ok=True)
    model = _pycolmap.read_model(known)
    if not _pycolmap.triangulate_points(model, (database, images), output, threads):
        raise InputError(
            f"{images}: COLMAP found no point that two of the {len(pictures)} pictures show; take frames "
            "that overlap more, or a network that needs no points"
        )


def _set_cameras(database: Path, pictures: Sequence[Picture]) -> dict[str, tuple[int, int]]:
    """Give every image of a database, each of which has a camera of its own, the one that is known.

    Written as SQL (tables of COLMAP's ``scene/database_sqlite.cc``), since versions name their methods
    differently. Returns name → (image id, camera id).
    """
    with closing(sqlite3.connect(database)) as connection, connection:
        rows = connection.execute("SELECT name, image_id, camera_id FROM images").fetchall()
        ids = {name: (image_id, camera_id) for name, image_id, camera_id in rows}
        for picture in pictures:
            c = picture.camera
            blob = np.array([c.fx, c.fy, c.cx, c.cy], "<f8").tobytes()
            connection.execute(
                "UPDATE cameras SET model = ?, width = ?, height = ?, params = ?, prior_focal_length = 1 "
                "WHERE camera_id = ?",
                (_PINHOLE, c.width, c.height, blob, ids[picture.name][1]),
            )
    return ids


def _posed(pictures: Sequence[Picture], ids: dict[str, tuple[int, int]]) -> SparseModel:
    """The cameras and poses with the ids of the database, without points."""
    none, no_ids = np.zeros((0, 2)), np.zeros(0, np.int64)
    cameras = {ids[picture.name][1]: picture.camera for picture in pictures}
    images = [
        SparseImage(ids[p.name][0], p.name, ids[p.name][1], p.cam_from_world, none, no_ids) for p in pictures
    ]
    points = SparsePoints(
        no_ids,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        np.zeros(0),
        np.zeros(1, np.int64),
        no_ids,
        no_ids,
    )
    return SparseModel(cameras, images, points)
