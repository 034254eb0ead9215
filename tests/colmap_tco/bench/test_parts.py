"""Parts of the bench: figures exact where the answer is known, rows, schedules, published figures."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from colmap_tco.bench.figures import point_figures, pose_figures
from colmap_tco.bench.methods import check_row, check_settings, held_priors, reconstruct, rescaled
from colmap_tco.bench.noise import Noise
from colmap_tco.bench.numbers import published as numbers
from colmap_tco.bench.prepare import resized, unproject
from colmap_tco.bench.rows import MEANING, parse_rows
from colmap_tco.bench.schedules import SCHEDULES, published
from colmap_tco.datasets import CHOICES, NRGBD
from colmap_tco.datasets.base import pixel_centres, project
from colmap_tco.errors import InputError
from tco.geometry import rigid, so3_exp
from tco.objective import ObjectiveConfig
from tco.options import EVERY, AblationConfig, TCOConfig
from tco.penalties import in_first_view, rotation_angle
from tco.terms import comparison
from tco.types import Cameras, Priors
from tests.colmap_tco.datasets import layouts
from tests.tco.published import tiny_vggt


def test_prepared_points_are_on_the_wall_and_project_to_their_pixels(tmp_path: Path) -> None:
    """Cameras, canvas and depth of a resized scene agree, in the frame of the dataset."""
    layouts.nrgbd(tmp_path)
    scene = NRGBD(tmp_path).read("kitchen", [0, 1, 2])
    prepared = resized(scene, 112, 14)
    assert prepared.views.size == (84, 112)
    points = prepared.points[prepared.known]
    # Nearest lookup of depths in maps 160 wide for pixels 112 wide: within half a pixel's slope.
    assert np.quantile(np.abs(points @ layouts.NORMAL - layouts.OFFSET), 0.99) < 0.01
    for i in range(3):
        local = (
            prepared.points[i].reshape(-1, 3) - prepared.world_from_cam[i, :3, 3]
        ) @ prepared.world_from_cam[i, :3, :3]
        known = prepared.known[i].reshape(-1)
        xy = project(local[known], prepared.K[i])
        np.testing.assert_allclose(xy, pixel_centres(112, 84)[known], atol=1e-9)
    first = prepared.cameras.world_from_cam[0]
    torch.testing.assert_close(first, torch.eye(4), rtol=0, atol=1e-6)


def test_points_that_differ_by_a_similarity_have_no_error(tmp_path: Path) -> None:
    layouts.nrgbd(tmp_path)
    prepared = resized(NRGBD(tmp_path).read("kitchen", [0, 1, 2]), 56, 14)
    R = so3_exp(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)).numpy()
    moved = 3.7 * prepared.points @ R.T + [5, -2, 1]
    found = point_figures(moved, prepared.points, prepared.known)
    assert max(found[name] for name in ("acc_mean", "acc_med", "comp_mean", "comp_med")) < 1e-6
    assert min(found["nc_mean"], found["nc_med"]) > 0.999
    # An offset of every other view shows in metres, and a thousandfold in millimetres.
    moved[1] += 0.2 * 3.7
    off, thousand = (point_figures(moved, prepared.points, prepared.known, unit) for unit in (1.0, 1000.0))
    assert 0.005 < off["acc_mean"] < 0.2
    assert thousand["acc_mean"] == pytest.approx(1000 * off["acc_mean"])
    assert thousand["nc_mean"] == pytest.approx(off["nc_mean"])
    with pytest.raises(InputError, match="nothing to compare"):
        point_figures(moved, prepared.points, np.zeros_like(prepared.known))


def test_points_that_are_left_out_do_not_move_the_others_and_are_missed(tmp_path: Path) -> None:
    """A hundredth of the pixels, thirty times too far: they decide the alignment unless they are left out."""
    layouts.nrgbd(tmp_path)
    prepared = resized(NRGBD(tmp_path).read("kitchen", [0, 1, 2]), 56, 14)
    points, far = prepared.points.copy(), np.zeros_like(prepared.known)
    far[:, ::10, ::10] = True
    points[far] *= 30
    spoilt = point_figures(points, prepared.points, prepared.known)
    found = point_figures(points, prepared.points, prepared.known, kept=~far)
    assert found["acc_mean"] < 1e-6 and spoilt["comp_mean"] > 0.05
    assert 0 < found["comp_mean"] < 0.01, "the true points there have no point of ours at their place"


def test_poses_that_differ_by_a_similarity_have_no_error() -> None:
    poses = np.stack(layouts.poses(6))
    R = so3_exp(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64)).numpy()
    moved = poses.copy()
    moved[:, :3, :3] = R @ moved[:, :3, :3]
    moved[:, :3, 3] = 0.2 * moved[:, :3, 3] @ R.T + [1, 2, 3]
    assert max(pose_figures(moved, poses).values()) < 1e-5
    still = poses.copy()
    still[:, :3, 3] = 0
    with pytest.raises(InputError, match="cannot be aligned"):
        pose_figures(still, poses)


def test_unprojected_depth_is_where_the_camera_sees_it() -> None:
    camera = layouts.Camera(layouts.poses(1)[0], (20, 15), 18.0, 19.0, 9.0, 8.0)
    xyz = unproject(camera.depth()[None], camera.K[None], camera.pose[None])[0]
    np.testing.assert_allclose(xyz @ layouts.NORMAL, layouts.OFFSET, atol=1e-12)
    for row, column in ((0, 0), (14, 19), (7, 3)):
        np.testing.assert_allclose(camera.pixel(xyz[row, column]), [column + 0.5, row + 0.5])


def cameras(seed: int, count: int = 4) -> Cameras:
    g = torch.Generator().manual_seed(seed)
    pose = rigid(so3_exp(0.2 * torch.randn(count, 3, generator=g)), torch.randn(count, 3, generator=g))
    return Cameras(pose, torch.eye(3).repeat(count, 1, 1) * 50)


def test_prior_cameras_take_the_networks_mean_distance_and_keep_their_rotations() -> None:
    ours, predicted = cameras(0), cameras(1)
    found = rescaled(ours, predicted)
    a, b = (in_first_view(c.world_from_cam)[:, :3, 3].norm(dim=-1).mean() for c in (found, predicted))
    torch.testing.assert_close(a, b)
    relative = in_first_view(ours.world_from_cam)
    torch.testing.assert_close(found.world_from_cam[:, :3, :3], relative[:, :3, :3])
    direction = torch.nn.functional.normalize
    torch.testing.assert_close(
        direction(found.world_from_cam[1:, :3, 3], dim=-1), direction(relative[1:, :3, 3], dim=-1)
    )
    one = rescaled(cameras(0, 1), cameras(1, 1))
    assert bool(torch.isfinite(one.world_from_cam).all())


def test_raw_depth_has_the_prior_cameras_and_base_the_networks_own(tmp_path: Path) -> None:
    layouts.nrgbd(tmp_path, 4)
    prepared = resized(NRGBD(tmp_path).read("kitchen", range(4)), 56, 14)
    network, device = tiny_vggt(), torch.device("cpu")
    rows = parse_rows(["base", "raw-depth", "tco"], ["pose", "intrinsics"])
    base, raw, _ = (
        reconstruct(network, prepared, row, TCOConfig(steps=0), device).world_from_cam for row in rows
    )
    truth = torch.from_numpy(prepared.world_from_cam)

    def turn(poses: np.ndarray) -> float:
        relative = in_first_view(torch.from_numpy(poses))
        return float(rotation_angle(relative[:, :3, :3], in_first_view(truth)[:, :3, :3]).max())

    assert turn(raw) < 1e-3 < turn(base)


def test_penalties_bring_the_networks_cameras_to_the_priors(tmp_path: Path) -> None:
    """With them alone, rotations of a network of random weights come nearer to the truth."""
    layouts.nrgbd(tmp_path, 4)
    prepared = resized(NRGBD(tmp_path).read("kitchen", range(4)), 56, 14)
    network = tiny_vggt()
    (row,) = parse_rows(["no-compatibility"], ["pose", "intrinsics"])
    plain = published("nrgbd", TCOConfig(steps=8, rate=2e-3))
    truth = in_first_view(torch.from_numpy(prepared.world_from_cam))

    def turn(steps: int) -> float:
        made = reconstruct(network, prepared, row, replace(plain, steps=steps), torch.device("cpu"))
        relative = in_first_view(torch.from_numpy(made.world_from_cam))
        return float(rotation_angle(relative[:, :3, :3], truth[:, :3, :3]).mean())

    assert turn(8) < 0.7 * turn(0)


def test_rows_change_what_they_say_and_nothing_else() -> None:
    plain = TCOConfig()
    names = [
        "base",
        "tco",
        "rank=16",
        "radius=0.05",
        "steps=80",
        "surfels",
        "no-compatibility",
        "noise=1/0.01/0",
    ]
    rows = {row.name: row for row in parse_rows(names, ["intrinsics", "pose"])}
    before = asdict(plain)

    def changed(name: str) -> dict[str, object]:
        after = asdict(rows[name].config(plain))
        found = {key: value for key, value in after.items() if value != before[key]}
        ablation = found.pop("ablation", {})
        return found | {k: v for k, v in ablation.items() if v != before["ablation"][k]}

    assert changed("base") == {"steps": 0} and rows["base"].priors == ()
    assert changed("tco") == {} and rows["tco"].priors == ("pose", "intrinsics")
    assert changed("rank=16") == {"lora_rank": 16}
    assert changed("radius=0.05") == {"radius_factor": 0.05}
    assert changed("steps=80") == {"steps": 80}
    more = rows["steps=80"].config(replace(plain, uncertain_steps=99))
    assert (more.steps, more.uncertain_steps) == (80, 0)
    assert changed("surfels") == {"lora_targets": (), "free_depth": True, "free_surfels": True}
    assert set(changed("no-compatibility")) == {"photometric_weight", "polish"}
    assert rows["noise=1/0.01/0"].noise == Noise(1, 0.01, 0)


@pytest.mark.parametrize(
    "name",
    ["rank", "rank=", "rank=0", "rank=1.5", "steps=-1", "radius=0", "radius=nan", "noise=1", "noise=1/2/inf",
     "tco=3", "Base", ""],
)  # fmt: skip
def test_what_is_no_row_is_refused_with_those_there_are(name: str) -> None:
    with pytest.raises(InputError, match="there are base"):
        parse_rows([name], ["pose"])


def test_every_row_of_the_documentation_can_be_parsed() -> None:
    values = {"N": "1", "X": "0.5", "R/T/F": "1/0.01/0.02"}
    for name in MEANING:
        kind, _, value = name.partition("=")
        parse_rows([f"{kind}={values[value]}" if value else kind], ["pose", "intrinsics"])


def test_published_settings_are_those_of_the_scripts_unless_the_user_says_otherwise() -> None:
    assert set(SCHEDULES) == set(CHOICES)
    found = published("7scenes", TCOConfig())
    assert (found.steps, found.rate, found.photometric_weight, found.lora_rank) == (40, 1e-3, 0.2, 4)
    assert found.ablation.decode_all and found.targets == EVERY and found.polish.polish_looks == 0
    assert published("dtu", TCOConfig(steps=7)).steps == 7
    poses = published("scannet", TCOConfig())
    assert (poses.photometric_weight, poses.geometric_weight, poses.depth_weight) == (0, 1, 1)
    for dataset in CHOICES:
        objective, surfels = comparison(published(dataset, TCOConfig()))
        assert objective == ObjectiveConfig.reference() and surfels.pixel_centre == 0
    own = TCOConfig(ablation=AblationConfig(radius_factor=1.0))
    assert comparison(published("dtu", own))[0].renderer == "surface"


@pytest.mark.parametrize(
    ("dataset", "steps", "rate", "photometric"),
    [
        ("7scenes", 40, 1e-3, 0.2),
        ("nrgbd", 40, 1e-4, 1),
        ("dtu", 50, 2e-4, 1),
        ("eth3d", 40, 5e-4, 0.2),
        ("scannet", 40, 2e-4, 0),
    ],
)
def test_every_dataset_has_the_settings_of_its_script(
    dataset: str, steps: int, rate: float, photometric: float
) -> None:
    """tco_steps, tco_lr and lambda_mv_consistency of scripts/tco_vggt_*.sh; ScanNet compares depths alone."""
    found = published(dataset, TCOConfig())
    assert (found.steps, found.rate, found.photometric_weight) == (steps, rate, photometric)
    depths = float(dataset == "scannet")
    assert (found.geometric_weight, found.depth_weight) == (depths, depths)
    assert (found.lora_rank, found.lora_alpha, found.clip) == (4, 16, 1)
    assert found.lora_targets == ("qkv", "proj", "fc1", "fc2")
    assert (found.sparse_weight, found.camera_rate, found.structure) == (0, 0, 0)
    assert not found.exposure and found.point_dropout == 0
    assert found.ablation.decode_all and found.ablation.source_order == "uniform"
    assert found.targets == EVERY and found.refresh == 1 and found.polish.polish_looks == 0
    assert found.ablation.unfrozen_rate == 1e-5  # heads_lr


@pytest.mark.parametrize(
    ("name", "priors", "weights", "depth"),
    [
        ("tco", "pose,intrinsics", (1, 2, 0.01), False),
        ("tco", "pose", (1, 2, 0), False),
        ("tco", "intrinsics", (0, 0, 0.01), False),
        ("tco", "depth", (0, 0, 0), True),
        ("pose", "pose,intrinsics", (1, 2, 0), False),
        ("intrinsics", "pose,intrinsics", (0, 0, 0.01), False),
        ("depth", "pose,intrinsics", (0, 0, 0), True),
        ("no-compatibility", "pose,intrinsics", (1, 2, 0.01), False),
        ("rank=1", "pose,intrinsics", (1, 2, 0.01), False),
        ("heads", "pose", (1, 2, 0), False),
    ],
)
def test_each_row_holds_its_priors_with_the_papers_weights(
    name: str, priors: str, weights: tuple[float, ...], depth: bool, tmp_path: Path
) -> None:
    layouts.nrgbd(tmp_path, 3)
    prepared = resized(NRGBD(tmp_path).read("kitchen", range(3)), 56, 14)
    (row,) = parse_rows([name], priors.split(","))
    found = held_priors(prepared, prepared.cameras, row)
    assert found.held is not None and found.cameras is None and found.sparse is None
    assert (found.held.rotation, found.held.translation, found.held.focal) == weights
    assert (found.depth is not None) == depth
    one = resized(NRGBD(tmp_path).read("kitchen", range(1)), 56, 14)
    alone = held_priors(one, one.cameras, row).held
    assert alone is not None and (alone.rotation, alone.translation, alone.focal) == (0, 0, weights[2])


def test_adapt_only_is_no_compatibility_with_views_compared() -> None:
    """So that the two differ in that alone."""
    adapt, silent = (
        row.config(TCOConfig()) for row in parse_rows(["adapt-only", "no-compatibility"], ["pose"])
    )
    assert adapt == replace(TCOConfig(), polish=silent.polish) and silent.polish.polish_looks == 0
    assert replace(silent, photometric_weight=adapt.photometric_weight) == adapt


def test_published_figures_have_their_source_and_their_gaps() -> None:
    for dataset, settings in CHOICES.items():
        for setting in settings:
            known = numbers(dataset, setting)
            assert len(known.systems) == 10
            assert set(known.rows) <= set(known.systems)
            assert (
                bool(known.rows) == bool(known.table) == (known.source is not None) == (dataset != "scannet")
            )
            if known.source is not None:
                assert known.source.url.startswith("https://") and "2507.13347" in known.source.of
            for figures in known.rows.values():
                assert 0 < figures["nc_mean"] < figures["nc_med"] < 1
                assert (
                    0 < figures["acc_med"] < figures["acc_mean"]
                    and figures["comp_med"] < figures["comp_mean"]
                )
    assert "TCO-VGGT" not in numbers("eth3d", "stride5").rows


def test_noise_has_the_size_that_it_says() -> None:
    many = cameras(3, 4000)
    noisy = Noise(3.0, 0.05, 0.02).cameras(many, seed=1)
    angle = torch.rad2deg(rotation_angle(many.world_from_cam[:, :3, :3], noisy.world_from_cam[:, :3, :3]))
    assert float(angle.square().mean().sqrt()) == pytest.approx(3.0, rel=0.05)
    centre = many.world_from_cam[:, :3, 3]
    unit = (centre - centre.mean(0)).norm(dim=-1).mean()
    shift = (noisy.world_from_cam[:, :3, 3] - centre).norm(dim=-1) / unit
    assert float(shift.square().mean().sqrt()) == pytest.approx(0.05, rel=0.05)
    zoom = (noisy.K[:, 0, 0] / many.K[:, 0, 0]).log()
    assert float(zoom.std()) == pytest.approx(0.02, rel=0.05)
    assert torch.equal(noisy.K[:, 0, 0], noisy.K[:, 1, 1])
    same = Noise().cameras(many, seed=1)
    torch.testing.assert_close(same.world_from_cam, many.world_from_cam)


def test_noise_is_told_as_it_is_or_so_many_times_as_large() -> None:
    """Each axis has a third of the variance, added to what was uncertain before; the cameras are the same."""
    exact = cameras(2)
    centre = exact.world_from_cam[:, :3, 3]
    unit = (centre - centre.mean(0)).norm(dim=-1).mean()
    before = torch.full((4,), 0.003)
    given = Priors(exact, rotation_sigma=before, centre_sigma=before, focal_sigma=before)
    noise = Noise(3.0, 0.05, 0.02)
    for stated in (1.0, 0.5, 3.0):
        noisy = noise(given, 1, stated)
        assert noisy.cameras is not None
        torch.testing.assert_close(noisy.cameras.world_from_cam, noise.cameras(exact, 1).world_from_cam)
        for sigma, one in (
            (noisy.rotation_sigma, np.radians(3.0) / 3**0.5),
            (noisy.centre_sigma, 0.05 * float(unit) / 3**0.5),
            (noisy.focal_sigma, 0.02),
        ):
            expected = torch.tensor((0.003**2 + (stated * one) ** 2) ** 0.5, dtype=torch.float32)
            torch.testing.assert_close(sigma, expected.expand(4))


def test_networks_that_predict_cameras_can_run_every_row() -> None:
    for row in parse_rows(
        ["base", "raw-depth", "tco", "pose", "intrinsics", "heads"], ["pose", "intrinsics"]
    ):
        check_row(tiny_vggt(), row)


def test_settings_that_count_for_nothing_are_refused() -> None:
    (row,) = parse_rows(["tco"], ("pose", "intrinsics"))
    check_settings(row, TCOConfig())
    with pytest.raises(InputError, match="--own_cameras uncertainty: the cameras of a dataset have no"):
        check_settings(row, TCOConfig(own_cameras="uncertainty"))
