"""The command from a folder of NRGBD to the table, with real networks: a tiny VGGT and the embedded one."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_tco.backbones import NetworkConfig
from colmap_tco.bench.command import DATASETS, BenchConfig, bench, width
from colmap_tco.errors import InputError, PartlyDoneError
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS
from tco.backbones.checkpoints import save
from tco.options import TCOConfig
from tests.colmap_tco.datasets import layouts
from tests.conftest import Room
from tests.tco.published import TINY_VGGT, tiny_vggt
from training.scenes import Sample

COLUMNS = ("acc_mean", "acc_med", "comp_mean", "comp_med", "nc_mean", "nc_med")


def write_room(root: Path, sample: Sample, scene: str) -> None:
    """A rendered room as NRGBD has it."""
    rows = []
    for i, (image, depth) in enumerate(zip(sample.images, sample.depth, strict=True)):
        (root / scene / "images").mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(root / scene / "images" / f"img{i}.png"), image[..., ::-1])
        layouts.millimetres(root / scene / "depth" / f"depth{i}.png", depth)
        rows.append(np.linalg.inv(sample.cam_from_world[i].astype(float)) @ layouts.GL)
    layouts.matrix(root / scene / "poses.txt", np.concatenate(rows))
    layouts.text(root / scene / "focal.txt", f"{sample.K[0, 0, 0]}\n")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save(path, tiny_vggt().network, TINY_VGGT)
    return path


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of four views and one of three, with some texture for the views to be compared by."""
    root = tmp_path_factory.mktemp("nrgbd")
    layouts.nrgbd(root, 4)
    layouts.nrgbd(root, 3, "staircase")
    g = np.random.default_rng(0)
    for path in sorted(root.rglob("img*.png")):
        coarse = g.integers(0, 255, (9, 12, 3), np.uint8)
        assert cv2.imwrite(str(path), cv2.resize(coarse, (160, 120), interpolation=cv2.INTER_CUBIC))
    return root


@pytest.fixture
def config(rooms: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BenchConfig:
    """Small pictures, all views (the published strides need sequences of a thousand frames), two steps."""
    from colmap_tco.datasets import CHOICES, Choice

    monkeypatch.setitem(CHOICES, "nrgbd", {"sparse": Choice(1)})
    return BenchConfig(
        dataset="nrgbd",
        root=rooms,
        output=tmp_path / "out",
        image_width=56,
        network=NetworkConfig(backbone="vggt", weights=str(weights), device="cpu"),
        tco=TCOConfig(steps=2),
    )


def table(config: BenchConfig, name: str = "table") -> dict[str, dict[str, str]]:
    """Row (and scene) → column → text of a CSV."""
    path = config.output / "nrgbd-sparse-vggt" / f"{name}.csv"
    lines = list(csv.DictReader(path.read_text().splitlines()))
    return {f"{line['row']}, {line['scene']}" if "scene" in line else line["row"]: line for line in lines}


ROWS = ("base", "raw-depth", "tco", "pose", "intrinsics", "no-compatibility", "rank=1",
        "radius=2", "heads", "surfels", "steps=0", "noise=3/0.05/0.05")  # fmt: skip


def figures(config: BenchConfig, row: str, scene: str) -> dict[str, float]:
    path = config.output / "nrgbd-sparse-vggt" / row.replace("/", "_") / f"{scene}.json"
    found: dict[str, float] = json.loads(path.read_text())["result"]["figures"]
    return found


def test_all_rows_run_and_differ_where_they_should(config: BenchConfig) -> None:
    bench(replace(config, rows=ROWS, scenes=("kitchen",), tco=TCOConfig(steps=2, rate=0.01)), Progress())
    assert tuple(table(config)) == ROWS
    found = {row: tuple(figures(config, row, "kitchen").values()) for row in ROWS}
    assert all(np.isfinite(values).all() and min(values) > 0 for values in found.values())
    # Open3D sums in the order in which its threads come.
    assert found["base"] == pytest.approx(found["steps=0"], rel=1e-9)
    others = {tuple(f"{value:.9e}" for value in found[row]) for row in ROWS if row != "steps=0"}
    assert len(others) == len(ROWS) - 1


def test_the_tables_hold_the_means_over_scenes_beside_the_published_figures(config: BenchConfig) -> None:
    done = bench(replace(config, rows=("base", "raw-depth")), Progress())
    rows, text = table(config), done.table.read_text()
    for row, line in rows.items():
        each = [figures(config, row, scene) for scene in ("kitchen", "staircase")]
        for column in COLUMNS:
            assert float(line[column]) == pytest.approx(np.mean([f[column] for f in each]), abs=6e-4)
        assert f"| {row} | {' | '.join(line[c] for c in COLUMNS)} | 2 of 2 |" in text
    assert "| *VGGT, published* | 0.051 | 0.029 | 0.066 | 0.038 | 0.890 | 0.981 |" in text
    assert "| *TCO-VGGT, published* | not available here |" in text
    assert "Table 4" in text and "arXiv 2507.13347" in text
    assert done.summary().startswith(text)


def test_finished_scenes_are_kept_and_other_settings_are_an_error(config: BenchConfig) -> None:
    bench(replace(config, rows=("base",), scenes=("kitchen",)), Progress())
    kept = config.output / "nrgbd-sparse-vggt" / "base" / "kitchen.json"
    before = kept.stat().st_mtime_ns
    bench(replace(config, rows=("base", "raw-depth")), Progress())
    assert kept.stat().st_mtime_ns == before
    assert set(table(config, "scenes")) == {
        f"{row}, {scene}" for row in ("base", "raw-depth") for scene in ("kitchen", "staircase")
    }
    changed = replace(config, rows=("base",), image_width=42)
    with pytest.raises(InputError, match=r"kitchen\.json was made with other settings \(image_width\)"):
        bench(changed, Progress())
    assert kept.stat().st_mtime_ns == before
    bench(replace(changed, overwrite=True), Progress())
    assert json.loads(kept.read_text())["settings"]["image_width"] == 42
    kept.write_text("{")
    with pytest.raises(InputError, match="no result of this command"):
        bench(changed, Progress())


def test_a_scene_that_fails_has_a_reason_and_the_others_figures(config: BenchConfig, tmp_path: Path) -> None:
    root = tmp_path / "broken"
    for name in ("kitchen", "staircase"):
        layouts.nrgbd(root, 3, name)
    (root / "staircase" / "depth" / "depth1.png").unlink()
    broken = replace(config, root=root, rows=("base",))
    with pytest.raises(PartlyDoneError, match=r"1 scenes without figures.*depth1\.png"):
        bench(broken, Progress())
    scenes = table(config, "scenes")
    assert scenes["base, kitchen"]["acc_mean"] and not scenes["base, staircase"]["acc_mean"]
    assert "depth1.png" in scenes["base, staircase"]["failed"]
    assert "1 of 2" in (config.output / "nrgbd-sparse-vggt" / "table.md").read_text()
    shutil.copy(root / "kitchen/depth/depth1.png", root / "staircase/depth/depth1.png")
    bench(broken, Progress())
    assert table(config, "scenes")["base, staircase"]["acc_mean"]


def test_one_frame_has_no_other_to_be_compared_with(config: BenchConfig, tmp_path: Path) -> None:
    """NRGBD's thin_geometry has one frame in the sparse setting; no row of it stops the others."""
    layouts.nrgbd(tmp_path / "one", 1)
    rows = ("raw-depth", "surfels", "tco", "pose", "noise=3/0.05/0.05")
    bench(replace(config, root=tmp_path / "one", rows=rows), Progress())
    found = {row: tuple(figures(config, row, "kitchen").values()) for row in rows}
    assert found["surfels"] == pytest.approx(found["raw-depth"], rel=1e-9)


def test_a_row_that_cannot_end_is_listed_and_the_others_go_on(config: BenchConfig) -> None:
    """Without adapters there is nothing that the steps could change."""
    nothing = replace(config, rows=("base", "tco"), scenes=("kitchen",))
    with pytest.raises(PartlyDoneError, match=r"1 scenes without figures \(tco, kitchen: there is nothing"):
        bench(replace(nothing, tco=TCOConfig(steps=1, lora_targets=())), Progress())
    scenes = table(config, "scenes")
    assert scenes["base, kitchen"]["acc_mean"] and "nothing to optimise" in scenes["tco, kitchen"]["failed"]


def test_other_weights_of_the_same_size_or_another_root_are_other_settings(
    config: BenchConfig, rooms: Path, tmp_path: Path
) -> None:
    one = replace(config, rows=("base",), scenes=("kitchen",))
    mine = tmp_path / "mine.safetensors"
    shutil.copyfile(config.network.weights, mine)
    one = replace(one, network=replace(one.network, weights=str(mine)))
    bench(one, Progress())
    other = bytearray(mine.read_bytes())
    other[-1] ^= 1
    mine.write_bytes(other)
    with pytest.raises(InputError, match=r"made with other settings \(weights\)"):
        bench(one, Progress())
    other[-1] ^= 1
    mine.write_bytes(other)
    shutil.copytree(rooms, tmp_path / "copy")
    with pytest.raises(InputError, match=r"made with other settings \(root\)"):
        bench(replace(one, root=tmp_path / "copy"), Progress())
    bench(one, Progress())


def test_the_tables_have_what_earlier_calls_made_alike(config: BenchConfig) -> None:
    bench(replace(config, rows=("raw-depth",), scenes=("staircase",)), Progress())
    bench(replace(config, rows=("steps=0",), image_width=42), Progress())
    done = bench(replace(config, rows=("base",), scenes=("kitchen",)), Progress())
    assert tuple(table(config)) == ("base", "raw-depth")
    assert set(table(config, "scenes")) == {"base, kitchen", "raw-depth, staircase"}
    assert "| raw-depth |" in done.text and "steps=0" not in done.text
    bench(replace(config, rows=("raw-depth",), scenes=("kitchen",)), Progress())
    assert tuple(table(config)) == ("raw-depth", "base")
    assert [line["scenes"] for line in table(config).values()] == ["2", "1"]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"dataset": "kitti"}, "--dataset 'kitti': there are eth3d"),
        ({"root": None}, "--root"),
        ({"setting": "stride5"}, "nrgbd has sparse"),
        ({"scenes": ("attic",)}, "--scenes attic: .* has kitchen, staircase"),
        ({"rows": ("best",)}, "--rows best: there are base"),
        ({"rows": ("rank=many",)}, "--rows rank=many"),
        ({"rows": ("tco", "tco")}, "twice"),
        ({"priors": ("depth",)}, "the truth that points are compared with"),
        ({"priors": ("color",)}, "--priors color"),
        ({"priors": ("pose",), "rows": ("raw-depth",)}, "give --priors pose,intrinsics"),
    ],
)  # fmt: skip
def test_what_does_not_go_together_is_told_before_anything_runs(
    changes: dict[str, object], told: str, config: BenchConfig
) -> None:
    with pytest.raises(InputError, match=told):
        bench(replace(config, **changes), Progress())  # type: ignore[arg-type]
    assert not config.output.exists()


def test_poses_from_depths_on_scannet(config: BenchConfig, tmp_path: Path) -> None:
    layouts.scannet(tmp_path / "scannet", 8, prepared=True)
    scannet = replace(
        config, dataset="scannet", root=tmp_path / "scannet", rows=("base", "tco", "no-compatibility")
    )
    done = bench(scannet, Progress())
    assert done.table.parent.name == "scannet-stride1-vggt"
    lines = list(csv.DictReader((done.table.parent / "scenes.csv").read_text().splitlines()))
    assert [line["views"] for line in lines] == ["6"] * 3
    assert all(float(line["rpe_rot"]) > 0 for line in lines)
    found = [
        json.loads(path.read_text())["result"]["figures"]["ate"] for path in done.table.parent.rglob("*.json")
    ]
    assert len(set(found)) == 3
    with pytest.raises(InputError, match="give --depth_weight"):
        bench(replace(scannet, rows=("tco",), published_settings=False, overwrite=True), Progress())
    with pytest.raises(InputError, match="poses are measured"):
        bench(replace(scannet, rows=("pose",)), Progress())


def test_pictures_are_as_wide_as_in_the_published_evaluations() -> None:
    """ScanNet's are loaded 512 wide and cut to whole patches of 14 pixels, the others 518 wide."""
    for name in ("vggt", "pi3", "da3"):
        wide = {dataset: width(BenchConfig(dataset=dataset), NETWORKS[name]) for dataset in DATASETS}
        assert wide == {"eth3d": 518, "dtu": 518, "7scenes": 518, "nrgbd": 518, "scannet": 512 // 14 * 14}
    assert width(BenchConfig(dataset="scannet"), NETWORKS["sweep"]) == 320
    assert width(BenchConfig(dataset="scannet", image_width=70), NETWORKS["vggt"]) == 70


@pytest.mark.slow
def test_the_embedded_network_reconstructs_a_room_from_prior_cameras_alone(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points are triangulated from the pictures; half of what is found is within 2 % of the room's depth."""
    from colmap_tco.datasets import CHOICES, Choice

    monkeypatch.setitem(CHOICES, "nrgbd", {"sparse": Choice(1)})
    write_room(tmp_path / "n", room.sample, "kitchen")
    config = BenchConfig(
        dataset="nrgbd",
        root=tmp_path / "n",
        output=tmp_path / "out",
        image_width=128,
        rows=("steps=0", "noise=0/0/0"),
        network=NetworkConfig(backbone="sweep", device="cpu"),
        tco=TCOConfig(steps=1),
    )
    bench(config, Progress())
    folder = tmp_path / "out" / "nrgbd-sparse-sweep"
    lines = {line["row"]: line for line in csv.DictReader((folder / "table.csv").read_text().splitlines())}
    depth = float(np.median(room.sample.depth))
    for line in lines.values():
        assert float(line["acc_med"]) < 0.02 * depth and float(line["comp_med"]) < 0.02 * depth
        assert float(line["nc_med"]) > 0.8
    with pytest.raises(InputError, match="sweep takes poses and intrinsics as input"):
        bench(replace(config, rows=("base",)), Progress())
