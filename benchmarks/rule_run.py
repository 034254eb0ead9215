"""``densify`` with the published networks at full size, on weights made by a rule: all but the meaning.

    python -m benchmarks.rule_run [--networks vggt pi3] [--set office] [--work DIR] [-- FLAG …]

Writes a checkpoint with the authors' names and shapes (5.0 and 3.8 GB; :mod:`benchmarks.rule`), runs the
command on a copy of a shared set with it, one for each network, and prints a Markdown table: exit code,
seconds, peak memory, which outputs are missing, and what the run says of its quality. Weights made by a rule
know nothing, so the run must say that the result contradicts COLMAP's points, and must not end with 0.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from benchmarks.backbone import NETWORKS
from benchmarks.quality import copied, measured
from benchmarks.rule import array
from colmap_tco.workspace import DensePaths

FLAGS = ("--steps", "2", "--max_image_size", "112", "--device", "cpu")


def write_weights(network: nn.Module, path: Path) -> None:
    """A checkpoint of a network whose tensors may be on no device, named as its authors name them."""
    from safetensors.numpy import save_file

    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    part = path.with_suffix(".part")
    save_file({name: np.ascontiguousarray(array(name, shape)) for name, shape in shapes.items()}, part)
    part.replace(path)


def lacking(dense: Path, report: dict[str, Any]) -> list[str]:
    """What a dense workspace should hold by its report, and does not."""
    paths = DensePaths(dense)
    every = [
        paths.ply, paths.vis, paths.report, paths.page, paths.fusion_cfg, paths.patch_match_cfg,
        *(paths.sparse / f"{name}.bin" for name in ("cameras", "images", "points3D")),
    ]  # fmt: skip
    for name, view in report["views"].items():
        if view["state"] == "used":
            maps = (paths.depth_map, paths.normal_map, paths.confidence_map, paths.error_map, paths.image)
            every += [*(path(name) for path in maps), *paths.own_maps(name)]
    return [str(path.relative_to(dense)) for path in every if not path.is_file()]


def verdict(text: str) -> str:
    """The line in which the run says what its result is worth."""
    lines = [line for line in text.splitlines() if "contradict" in line or line.startswith("error")]
    return lines[-1].strip() if lines else "no word of its quality"


def main() -> None:
    """Command line; what follows ``--`` is given to ``densify`` in place of its small defaults here."""
    own, rest = sys.argv[1:], list(FLAGS)
    if "--" in own:
        own, rest = own[: own.index("--")], own[own.index("--") + 1 :]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--networks", nargs="+", default=list(NETWORKS), choices=list(NETWORKS))
    parser.add_argument("--set", default="office", help="one of ../shared/data")
    parser.add_argument("--work", type=Path, default=Path("runs/rule"))
    args = parser.parse_args(own)
    args.work.mkdir(parents=True, exist_ok=True)
    out = sys.stdout
    out.write("| network | exit | s | GiB | chunks | missing | points | verdict |\n" + "|---" * 8 + "|\n")
    for network in args.networks:
        weights = args.work / f"{network}-rule.safetensors"
        if not weights.exists():
            _, build, published, _ = NETWORKS[network]
            with torch.device("meta"):
                made = build(published)
            write_weights(made, weights)
        workspace = copied(args.set, args.work / network)
        command = [sys.executable, "-m", "colmap_tco", "densify", str(workspace), "--overwrite"]
        done = measured([*command, "--backbone", network, "--weights", str(weights), *rest])
        dense = workspace / "dense-tco"
        report = json.loads((dense / "report.json").read_text("utf-8"))
        missing = lacking(dense, report)
        out.write(
            f"| {network} | {done.code} | {done.seconds:.0f} | {done.peak:.1f} | {len(report['chunks'])} "
            f"| {', '.join(missing) or 'none'} | {report['points']} | {verdict(done.text)} |\n"
        )
        out.flush()


if __name__ == "__main__":
    main()
