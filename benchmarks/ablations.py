"""The paper's ablations and our switches on the real sets: what each changes in accuracy and in seconds.

    python -m benchmarks.ablations [--output docs/ablations.md] [--only rank,heads]

Every row is the default configuration with one thing changed. What is the head or the last part of the
network is taken from its structure, so that any backbone can be put in.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import nn

from benchmarks.real import arguments, load, median_error, publish, within
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.lora import select
from tco.optimize import optimize
from tco.options import AblationConfig, PolishConfig, TCOConfig


def variants(decoder: nn.Module, plain: TCOConfig) -> Iterator[tuple[str, TCOConfig]]:
    """Names and configurations."""
    layers = list(select(decoder, ("*",)))
    last = layers[-1].split(".")[0]
    heads = [name for name, _ in decoder.named_modules() if name.split(".")[-1].endswith("head")]
    slow = replace(plain, rate=plain.rate / 10)

    def ablation(config: TCOConfig = plain, **changes: object) -> TCOConfig:
        return replace(config, ablation=AblationConfig(**changes))  # type: ignore[arg-type]

    yield "network alone", replace(plain, steps=0)
    yield "adapted", plain
    polish = PolishConfig()
    yield "depths polished, network as it is", replace(plain, steps=1, rate=0.0, polish=polish)
    yield "adapted, then polished (what densify does)", replace(plain, polish=polish)
    rendered = replace(polish, polish_renders=True)
    yield "depths polished by rendering", replace(plain, steps=1, rate=0.0, polish=rendered)
    fine = replace(polish, polish_levels=(1,))
    yield "depths polished pixel by pixel", replace(plain, steps=1, rate=0.0, polish=fine)
    for rank in (1, 16):
        yield f"rank {rank}", replace(plain, lora_rank=rank)
    yield f"adapters on the last part only ({last})", replace(plain, lora_targets=(f"{last}.*",))
    yield "heads trained in full, too", ablation(slow, unfrozen=tuple(heads or layers[-1:]))
    yield "decoder trained in full, no adapters", ablation(replace(slow, lora_targets=()), unfrozen=("*",))
    yield (
        "depths of pixels instead of the network",
        ablation(replace(plain, lora_targets=()), free_depth=True, free_rate=2e-3),
    )
    yield "radii and orientations learned, too", ablation(free_surfels=True)
    yield "opaque surfels", ablation(confident_opacity=False)
    for factor in (0.05, 1.0, 2.0):
        yield f"radius factor {factor}", ablation(radius_factor=factor)
    for name in ("photometric", "consistency", "sparse"):
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


def main() -> None:
    """Command line."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--only", default="", help="parts of names of variants, separated by commas")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each; their mean and spread are shown")
    args = parser.parse_args()
    network = load_sweep(args.weights or EMBEDDED)
    sets = [load(name, args.size, args.views) for name in args.sets]
    wanted = [word for word in args.only.split(",") if word]
    lines = [
        "# Ablations\n",
        f"`python -m benchmarks.ablations --steps {args.steps} --seeds {args.seeds}`, sets "
        f"{', '.join(args.sets)}: {args.views or 'all'} views of {args.size} pixels, {args.steps} "
        f"steps on the network, means of {args.seeds} run(s). Share of measured pixels within 5 %, its "
        "standard deviation over the runs, median error, seconds of CPU.\n",
        "| | " + " | ".join(args.sets) + " |",
        "|---" * (len(sets) + 1) + "|",
    ]
    for name, config in variants(
        network.decoder(), TCOConfig(steps=args.steps, polish=PolishConfig(polish_looks=0))
    ):
        if wanted and not any(word in name for word in wanted):
            continue
        cells = []
        for real in sets:
            figures = []
            for seed in range(args.seeds):
                start = time.process_time()
                prediction = optimize(network, real.views, real.given, config, seed).prediction
                seconds = time.process_time() - start
                figures.append(
                    (within(prediction, real.truth), median_error(prediction, real.truth), seconds)
                )
            share, error, seconds = torch.tensor(figures).mean(0).tolist()
            spread = f" ± {torch.tensor(figures)[:, 0].std():.3f}" if args.seeds > 1 else ""
            cells.append(f"{share:.3f}{spread} {100 * error:.2f} % {seconds:.0f} s")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        publish("\n".join(lines) + "\n", args.output) if args.output else publish(lines[-1] + "\n", None)


if __name__ == "__main__":
    main()
