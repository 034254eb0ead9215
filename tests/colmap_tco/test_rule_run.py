"""``densify`` on a real workspace with weights that know nothing: all is written, nothing is praised."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from torch import nn

from benchmarks.backbone import NETWORKS
from benchmarks.quality import copied
from benchmarks.rule import by_rule
from benchmarks.rule_run import lacking, verdict
from colmap_tco.errors import PartlyDoneError
from tco.backbones.checkpoints import save
from tests.tco.test_vggt import SMALL

ROOT = Path(__file__).resolve().parents[2]
SIZES: dict[str, Any] = {"vggt": SMALL, "pi3": NETWORKS["pi3"][3]}
"""VGGT of the reference numbers ``vggt_small``, and a π³ of a few layers."""
FLAGS = ("--max_image_size", "70", "--steps", "1", "--polish_looks", "1", "--device", "cpu",
         "--recompute", "always")  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", SIZES)
def test_densify_with_weights_by_the_rule(shared: Path, tmp_path: Path, kind: str) -> None:
    config, weights = SIZES[kind], tmp_path / "rule.safetensors"

    def build() -> nn.Module:
        made: nn.Module = NETWORKS[kind][1](config)
        return made

    save(weights, by_rule(build), config)
    workspace = copied("office", tmp_path)
    words = ["densify", str(workspace), "--backbone", kind, "--weights", str(weights), *FLAGS]
    done = subprocess.run(
        [sys.executable, "-m", "colmap_tco", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == PartlyDoneError.exit_code == 6, done.stderr
    told = verdict(done.stdout + done.stderr)
    assert "the depths contradict COLMAP's points (median error" in told and "do not use them" in told
    assert "its activations are computed again in each backward pass" in done.stderr
    dense = workspace / "dense-tco"
    report = json.loads((dense / "report.json").read_text("utf-8"))
    assert report["backbone"]["name"] == kind and report["images"]["used"] == len(report["views"]) == 15
    assert lacking(dense, report) == []
    assert not report["held_out"]["plausible"] and report["held_out"]["error"] > 0.05
    page = (dense / "report.html").read_text("utf-8")
    assert '"plausible":false' in page.replace(" ", "")
    (dense / "report.html").unlink()
    (dense / "stereo" / "confidence_maps" / f"{next(iter(report['views']))}.geometric.bin").unlink()
    assert len(lacking(dense, report)) == 2
