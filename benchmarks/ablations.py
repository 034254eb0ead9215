"""The paper's ablations and our switches on real and rendered sets: what each changes, in how many seconds.

    python -m benchmarks.ablations [--sets kitchen hills] [--output docs/ablations.md] [--only rank,heads]

Every row is the default configuration with one thing changed, on the network alone: depths are polished where
a row says so. Modules that are trained in full have a tenth of the adapters' rate. What is the head or the
last part of the network is taken from its structure, so that any backbone can be put in.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from torch import nn

from benchmarks.real import RealSet, arguments, load, median_error, within
from benchmarks.tables import cell, paragraph, publish, runs, weights_told
from tco.backbones.base import Backbone
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.lora import select
from tco.optimize import optimize
from tco.options import AblationConfig, PolishConfig, TCOConfig


def variants(decoder: nn.Module, plain: TCOConfig) -> Iterator[tuple[str, TCOConfig]]:
    """Names and configurations."""
    layers = list(select(decoder, ("*",)))
    last = layers[-1].split(".")[0]
    heads = [name for name, _ in decoder.named_modules() if name.split(".")[-1].endswith("head")]
    slow = plain.rate / 10

    def ablation(config: TCOConfig = plain, **changes: object) -> TCOConfig:
        return replace(config, ablation=AblationConfig(**changes))  # type: ignore[arg-type]

    yield "network alone", replace(plain, steps=0)
    yield "adapted", plain
    polish = PolishConfig()
    yield "depths polished, network as it is", replace(plain, steps=1, rate=0.0, polish=polish)
    yield "adapted, then polished (what densify does)", replace(plain, polish=polish)
    whole = replace(plain, polish=polish)
    yield "the same without colours", replace(whole, photometric_weight=0.0)
    yield "the same with L1 alone", replace(whole, structure=0.0)
    yield "the same without exposure", replace(whole, exposure=False)
    yield "the same without occlusion", replace(whole, occlusion_tolerance=1e9)
    fine = replace(polish, polish_levels=(1,))
    yield "depths polished pixel by pixel", replace(plain, steps=1, rate=0.0, polish=fine)
    for rank in (1, 16):
        yield f"rank {rank}", replace(plain, lora_rank=rank)
    yield f"adapters on the last part only ({last})", replace(plain, lora_targets=(f"{last}.*",))
    yield "heads trained in full, too", ablation(unfrozen=tuple(heads or layers[-1:]), unfrozen_rate=slow)
    yield (
        "decoder trained in full, no adapters",
        ablation(replace(plain, lora_targets=()), unfrozen=("*",), unfrozen_rate=slow),
    )
    yield (
        "depths of pixels instead of the network",
        ablation(replace(plain, lora_targets=()), free_depth=True, free_rate=2e-3),
    )
    yield (
        "surfels of pixels instead of the network",
        ablation(replace(plain, lora_targets=()), free_depth=True, free_surfels=True, free_rate=2e-3),
    )
    yield "radii and orientations learned, too", ablation(free_surfels=True)
    yield "opaque surfels", ablation(confident_opacity=False)
    for factor in (0.05, 1.0, 2.0, 5.0):
        yield f"radius factor {factor}", ablation(radius_factor=factor)
    for name in ("photometric", "sparse"):
        yield f"without the {name} term", replace(plain, **{f"{name}_weight": 0.0})  # type: ignore[arg-type]
    yield "L1 alone", replace(plain, structure=0.0)
    yield "no exposure", replace(plain, exposure=False)
    yield "no hidden points", replace(plain, point_dropout=0.0)
    yield "cameras held", replace(plain, camera_rate=0.0)
    yield "2 sources, half the steps", replace(plain, sources=2, steps=plain.steps // 2)
    yield "2 targets", replace(plain, targets=2)
    yield "all targets", replace(plain, targets=1_000)
    yield "sources by overlap", ablation(source_order="overlap")
    yield "sources uniform", ablation(source_order="uniform")
    yield "no refresh", replace(plain, refresh=10_000)
    yield "stop by hidden points", replace(plain, stop_after=plain.steps // 3)


def measured(network: Backbone, real: RealSet, config: TCOConfig, seeds: int) -> str:
    """Shares of the measured pixels within 2 and 5 %, median error and seconds of CPU, over the seeds."""
    near, shares, errors, seconds = [], [], [], []
    for seed in range(seeds if config.steps else 1):
        start = time.process_time()
        prediction = optimize(network, real.views, real.given, config, seed).prediction
        seconds.append(time.process_time() - start)
        near.append(within(prediction, real.truth, 0.02))
        shares.append(within(prediction, real.truth))
        errors.append(100 * median_error(prediction, real.truth))
    return f"{cell(near, 3)}, {cell(shares, 3)}, {cell(errors, 2)} %, {np.mean(seconds):.0f} s"


def parser() -> argparse.ArgumentParser:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--only", default="", help="parts of names of variants, separated by commas")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each")
    return parser


def main() -> None:
    """Measure and publish, row by row."""
    args = parser().parse_args()
    weights = args.weights or EMBEDDED
    network = load_sweep(weights)
    sets = [load(name, args.size, args.views) for name in args.sets]
    wanted = [word for word in args.only.split(",") if word]
    about = paragraph(
        f"`python -m benchmarks.ablations --steps {args.steps} --seeds {args.seeds}`: "
        f"{weights_told(weights)}, {args.views or 'all'} views of {args.size} pixels, {args.steps} steps on "
        f"the network, {runs(args.seeds)}. Shares of the measured pixels within 2 and 5 %, median error, "
        "seconds of CPU. Depths are those of each view alone; what they gain from each other is in "
        "`docs/consensus.md`. Modules that are trained in full have a tenth of the adapters' rate."
    )
    head = "| | " + " | ".join(args.sets) + " |\n" + "|---" * (len(sets) + 1) + "|\n"
    text = f"# Ablations\n\n{about}\n{head}"
    plain = TCOConfig(steps=args.steps, polish=PolishConfig(polish_looks=0))
    for name, config in variants(network.decoder(), plain):
        if wanted and not any(word in name for word in wanted):
            continue
        cells = [measured(network, real, config, args.seeds) for real in sets]
        line = f"| {name} | " + " | ".join(cells) + " |\n"
        text += line
        publish(text if args.output else line, args.output, args.part)


if __name__ == "__main__":
    main()
