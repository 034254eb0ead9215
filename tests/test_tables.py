"""The tables of docs/: the scripts that make them can be called as they are; a table keeps to its place."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as tables
from benchmarks import noise
from benchmarks.rendered import SCENES
from benchmarks.tables import FIRST, marks, paragraph, plot_beside, publish, runs, weights_told
from tco.backbones.weights import EMBEDDED

ROOT = Path(__file__).resolve().parents[1]
OF_SETS = ("claim", "ablations", "noise", "scaling")


@pytest.mark.parametrize("table", tables.TABLES, ids=lambda table: table.name)
def test_scripts_take_the_arguments_that_they_get(table: tables.Table, tmp_path: Path) -> None:
    """And the file has the part already, so that making it leaves what is written by hand."""
    parser = import_module(f"benchmarks.{table.script}").parser()
    args, rest = parser.parse_known_args(table.words(tmp_path))
    assert args.output == tmp_path / table.file and args.part == table.part
    assert not rest or table.script == "quality"
    words = [sys.executable, "-m", "colmap_tco", "densify", "--help_all"]
    options = subprocess.run(words, capture_output=True, text=True, check=True).stdout if rest else ""
    assert all(word in options for word in rest if word.startswith("--"))
    if table.part == FIRST:
        assert all(mark in (ROOT / "docs" / table.file).read_text("utf-8") for mark in marks(FIRST))


def test_names_and_parts_are_unique() -> None:
    assert len({table.name for table in tables.TABLES}) == len(tables.TABLES)
    assert len({(table.file, table.part) for table in tables.TABLES}) == len(tables.TABLES)


@pytest.mark.parametrize("script", OF_SETS)
def test_rendered_scenes_are_sets_like_the_real_ones(script: str) -> None:
    args = (
        import_module(f"benchmarks.{script}")
        .parser()
        .parse_args(["--sets", "office", *SCENES, "--seeds", "2"])
    )
    assert args.sets == ["office", *SCENES] and args.seeds == 2


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    """Two tables of which one writes its part and the other fails; the second call finds the first made."""
    monkeypatch.chdir(tmp_path)
    package = tmp_path / "benchmarks"
    package.mkdir()
    (package / "good.py").write_text(
        "import sys, pathlib\n"
        "file = pathlib.Path(sys.argv[sys.argv.index('--output') + 1])\n"
        "file.parent.mkdir(exist_ok=True)\n"
        f"with file.open('a') as f: f.write({marks(FIRST)[0]!r} + {marks(FIRST)[1]!r})\n"
    )
    (package / "bad.py").write_text("raise SystemExit('no sets here')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = tuple(tables.Table(name, name, f"{name}.md") for name in ("bad", "good"))
    monkeypatch.setattr(tables, "TABLES", found)
    return lambda *words: tables.main(["--output", "out", *words])


def test_what_fails_is_named_and_what_is_made_is_kept(
    two: Callable[..., int], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Path("out/good.md")
    assert two() == 1
    told = capfd.readouterr()
    assert "no sets here" in told.err and "without bad" in told.err and made.exists()
    before = made.read_text()
    assert two("--only", "good") == 0
    assert "made already" in capfd.readouterr().out and made.read_text() == before
    assert two("--only", "good", "--force") == 0
    assert made.read_text() == 2 * before
    monkeypatch.setattr(tables, "source", lambda table: "other code")
    assert two("--only", "good") == 0
    assert made.read_text() == 3 * before
    made.unlink()
    assert two("--only", "good") == 0 and made.exists()


def test_a_table_keeps_to_its_part_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "x.md"
    publish("# Title\n\n| 1 |\n", file)
    file.write_text("Before.\n\n" + file.read_text() + "\nBy hand.\n")
    publish("# Title\n\n| 2 |\n", file, "rendered")
    publish("# Title\n\n| 3 |\n", file)
    text = file.read_text()
    assert text.startswith(
        "Before.\n\n" + marks(FIRST)[0] + "# Title\n\n| 3 |\n" + marks(FIRST)[1] + "\nBy hand.\n"
    )
    assert text.endswith(marks("rendered")[0] + "## Title: rendered\n\n| 2 |\n" + marks("rendered")[1])
    assert "| 1 |" not in text
    file.write_text("Without marks.\n")
    publish("# Title\n", file)
    assert file.read_text() == "".join([marks(FIRST)[0], "# Title\n", marks(FIRST)[1]])
    assert plot_beside(file, FIRST).name == "x.png" and plot_beside(file, "a b").name == "x-a-b.png"


def test_tables_say_which_weights_they_are_of(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    assert weights_told(EMBEDDED).startswith("weights sweep.safetensors of step ")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    assert weights_told(tmp_path / "other.safetensors") == "weights other.safetensors"
    assert "Student" in runs(3) and runs(1) == "one seed"
    assert max(map(len, paragraph("word " * 100).split("\n"))) <= 118


def test_noise_of_one_seed_has_one_direction_whatever_its_size() -> None:
    """Rows of one kind are multiples of each other, and the row with all three is made of those with one."""
    from colmap_tco.bench.noise import Noise
    from tco.geometry import rigid, so3_exp
    from tco.types import Cameras

    g = torch.Generator().manual_seed(0)
    pose = rigid(so3_exp(0.2 * torch.randn(5, 3, generator=g)), torch.randn(5, 3, generator=g))
    exact = Cameras(pose, 50 * torch.eye(3).repeat(5, 1, 1))

    def shift(noise: Noise) -> torch.Tensor:
        return noise.cameras(exact, 4).world_from_cam[:, :3, 3] - pose[:, :3, 3]

    torch.testing.assert_close(shift(Noise(translation=0.1)), 10 * shift(Noise(translation=0.01)))
    every = Noise(3, 0.05, 0.02).cameras(exact, 4)
    torch.testing.assert_close(
        every.world_from_cam[:, :3, 3] - pose[:, :3, 3], shift(Noise(translation=0.05))
    )
    torch.testing.assert_close(
        every.world_from_cam[:, :3, :3], Noise(3).cameras(exact, 4).world_from_cam[:, :3, :3]
    )
    torch.testing.assert_close(every.K, Noise(focal=0.02).cameras(exact, 4).K)
    other = Noise(3, 0.05, 0.02).cameras(exact, 5)
    assert not torch.allclose(other.world_from_cam, every.world_from_cam)


def test_ways_to_use_noisy_cameras_differ_in_how_they_are_held_alone() -> None:
    """Plain and weighted give the network the corrected cameras alike."""
    from dataclasses import replace

    from tco.options import AblationConfig, PolishConfig

    ways = noise.ways(7, PolishConfig())
    assert ways["plain"] == replace(ways["weighted"], ablation=AblationConfig(plain_cameras=True))
    assert ways["weighted"].reencode > 0 and ways["network"].steps == 0
