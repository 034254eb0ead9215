"""``densify`` with the published networks at full size, on weights made by a rule: all but the meaning.

    python -m benchmarks.rule_run [--networks vggt pi3] [--set office] [--work DIR] [-- FLAG …]

Writes a checkpoint with the authors' names and shapes (5.0 and 3.8 GB; ``../shared/parity``), runs the
command on a copy of a shared set with it, and prints a Markdown table: exit code, seconds, peak memory,
which outputs are there, and what the run says of its quality. Weights made by a rule know nothing, so the
run must say that the result contradicts COLMAP's points, and must not end with 0.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

from benchmarks.quality import SHARED, copied, measured

PARITY = SHARED / "parity"
REFERENCES = {"vggt": "vggt_1b", "pi3": "pi3_large"}
CONSTANTS = {"image_mean": (0.485, 0.456, 0.406), "image_std": (0.229, 0.224, 0.225)}
OUTPUTS = (
    "fused.ply", "fused.ply.vis", "report.json", "sparse/cameras.bin", "sparse/images.bin", "images",
    "stereo/fusion.cfg", "stereo/patch-match.cfg", "stereo/depth_maps", "stereo/normal_maps",
)  # fmt: skip
FLAGS = ("--steps", "2", "--max_image_size", "112", "--device", "cpu")


def rule() -> ModuleType:
    """The rule that makes weights from names."""
    spec = importlib.util.spec_from_file_location("rule_weights", PARITY / "rule_weights.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"{PARITY}: the reference numbers are not there")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_weights(network: str, path: Path) -> None:
    """A checkpoint of a published network, as its authors name its tensors."""
    import numpy as np
    from safetensors.numpy import save_file

    table = json.loads((PARITY / f"{REFERENCES[network]}.json").read_text("utf-8"))
    make, tensors = rule().rule_array, {}
    for name, shape in table["state_dict"].items():
        if name in CONSTANTS:
            tensors[name] = np.reshape(np.array(CONSTANTS[name], np.float32), shape)
        else:
            tensors[name] = np.ascontiguousarray(make(name, tuple(shape), table["salt"]))
    part = path.with_suffix(".part")
    save_file(tensors, part)
    part.replace(path)


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
    parser.add_argument("--networks", nargs="+", default=list(REFERENCES), choices=list(REFERENCES))
    parser.add_argument("--set", default="office", help="one of ../shared/data")
    parser.add_argument("--work", type=Path, default=Path("runs/rule"))
    args = parser.parse_args(own)
    args.work.mkdir(parents=True, exist_ok=True)
    out = sys.stdout
    out.write("| network | exit | s | GiB | chunks | missing | points | verdict |\n" + "|---" * 8 + "|\n")
    for network in args.networks:
        weights = args.work / f"{network}-rule.safetensors"
        if not weights.exists():
            write_weights(network, weights)
        workspace = copied(args.set, args.work)
        command = [sys.executable, "-m", "colmap_tco", "densify", str(workspace), "--overwrite"]
        done = measured([*command, "--backbone", network, "--weights", str(weights), *rest])
        dense = workspace / "dense-tco"
        report = json.loads((dense / "report.json").read_text("utf-8"))
        views = report["images"]["used"]
        missing = [name for name in OUTPUTS if not (dense / name).exists()]
        missing += [
            f"{views - count} of {kind}"
            for kind in ("depth_maps", "normal_maps")
            if (count := len(list((dense / "stereo" / kind).glob("*.geometric.bin")))) != views
        ]
        out.write(
            f"| {network} | {done.code} | {done.seconds:.0f} | {done.peak:.1f} | {len(report['chunks'])} "
            f"| {', '.join(missing) or 'none'} | {report['points']} | {verdict(done.text)} |\n"
        )
        out.flush()


if __name__ == "__main__":
    main()
