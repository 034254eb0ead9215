"""Settings that cannot be are refused by the command line, before anything is computed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from colmap_tco.cli import main
from colmap_tco.errors import InputError
from colmap_tco.fusion import FusionConfig, fuse
from tests.colmap_tco.test_fusion import CONFIG, Scene

WRONG = [
    *(("densify", f"--{name}={value}", name) for name, value in [
        ("min_num_pixels", 0), ("check_num_images", 0), ("max_reproj_error", 0), ("max_depth_error", -1),
        ("max_normal_error", 0), ("max_normal_error", 181), ("cache_size", 0), ("max_view_angle", 91),
        ("max_view_angle", 0), ("min_confidence", -1), ("max_depth_bend", -0.1), ("max_conflicts", -1),
        ("sigma_at_one", -1), ("most_depth_error", -1), ("max_depth_ratio", -1), ("min_tri_angle", -1),
        ("min_tri_angle", 200), ("max_agreed_error", -1), ("voxel_size", -1), ("max_points", -1),
        ("roi", "1,2,3"), ("roi", "0,0,0,1,-1,1"), ("roi", "0,0,0,1,1,1,2"),
    ]),
    ("export las", "--max_points=-1", "max_points"),
    ("mesh", "--cell_size=-1", "cell_size"),
    ("mesh", "--cell_size=inf", "cell_size"),
    ("mesh", "--trim=-1", "trim"),
    ("mesh", "--max_distance=-1", "max_distance"),
    ("mesh", "--min_part=1", "min_part"),
]  # fmt: skip


@pytest.mark.parametrize(("command", "flag", "name"), WRONG)
def test_settings_out_of_range_are_errors_of_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, flag: str, name: str
) -> None:
    assert main([*command.split(), str(tmp_path), flag]) == 2
    assert f"--{name} " in capsys.readouterr().err


@pytest.mark.parametrize("name", ["max_depth_error", "voxel_size", "min_tri_angle"])
def test_no_number_is_no_setting(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        replace(FusionConfig(), **{name: float("nan")})  # type: ignore[arg-type]


def test_the_limits_themselves_are_allowed() -> None:
    """What switches a filter off, and a region without bound on a side."""
    off = dict.fromkeys(("max_depth_bend", "max_conflicts", "max_depth_ratio", "min_tri_angle"), 0.0)
    region = (-float("inf"), 0.0, 0.0, float("inf"), 1.0, 1.0)
    assert FusionConfig(**off, max_view_angle=90.0, max_normal_error=180.0, roi=region).roi == region  # type: ignore[arg-type]


def test_cubes_too_small_for_the_cloud_are_bad_input_and_the_size_told_is_large_enough() -> None:
    views = Scene(count=3).views()
    with pytest.raises(InputError, match=r"--voxel_size 1e-12 is too small .* give at least") as error:
        fuse(views, replace(CONFIG, voxel_size=1e-12))
    told = float(str(error.value).partition("at least ")[2].partition(",")[0])
    assert told < 1e-4
    assert len(fuse(views, replace(CONFIG, voxel_size=told))[0]) > 1000
