"""The benchmark of the fusion runs, and what it fuses is the scene that it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.fusion import in_files, main, scene
from colmap_tco.fusion import FusionConfig, fuse
from colmap_tco.workspace import dense_paths


def test_the_scene_is_two_spheres() -> None:
    cloud, report = fuse(scene(6, (96, 72), 5), FusionConfig(num_threads=1))
    radius = np.linalg.norm(cloud.points, axis=1)
    near = np.abs(radius - 1.5) < 0.02
    assert near.sum() > 100
    assert (near | (np.abs(radius - 9) < 0.2)).mean() > 0.98
    assert report.pixels["all"] == 6 * 96 * 72


def test_it_prints_a_row_for_every_number_of_views(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--views", "3", "--size", "64", "48", "--neighbours", "2", "--threads", "1", "--files"])
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    cells = [cell.strip() for cell in table[-1].strip("|").split("|")]
    assert len(table) == 3 and len(cells) == table[0].count("|") - 1
    assert cells[:2] == ["3", "0.01"]
    assert int(cells[2]) > 100


def test_maps_in_files_are_the_maps(tmp_path: Path) -> None:
    view = scene(1, (64, 48), 0)[0]
    before, after = view.load(), in_files(view, dense_paths(tmp_path)).load()
    for name in ("depth", "normal", "confidence"):
        assert (getattr(before, name) == getattr(after, name)).all()
    assert np.abs(before.image.astype(int) - after.image).mean() < 4
