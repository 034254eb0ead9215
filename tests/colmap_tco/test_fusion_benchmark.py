"""The benchmark of the fusion runs, and what it fuses is the scene that it says."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fusion import main, scene
from colmap_tco.fusion import FusionConfig, fuse


def test_the_scene_is_two_spheres() -> None:
    cloud, report = fuse(scene(6, (96, 72), 5), FusionConfig(num_threads=1))
    radius = np.linalg.norm(cloud.points, axis=1)
    near = np.abs(radius - 1.5) < 0.02
    assert near.sum() > 100
    assert (near | (np.abs(radius - 9) < 0.2)).mean() > 0.98
    assert report.pixels["all"] == 6 * 96 * 72


def test_it_prints_a_row_for_every_number_of_views(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--views", "3", "--size", "64", "48", "--neighbours", "2", "--threads", "1"])
    table = capsys.readouterr().out.splitlines()
    cells = [cell.strip() for cell in table[-1].strip("|").split("|")]
    assert len(table) == 3 and len(cells) == table[0].count("|") - 1
    assert cells[:4] == ["3", "2", "1", "0.01"]
    assert int(cells[4]) > 100
