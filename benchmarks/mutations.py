"""Change a sign, a factor or half a pixel, and see which test notices.

    python -m benchmarks.mutations [--only surfels,kernels] [--output docs/mutations.md]

Each mutation is a textual change of one place, applied to a copy of the tree, on which the test files of that
module are run until the first failure. A mutation that no test notices is a gap in the tests, and the command
then ends with status 1. Where ``../shared/parity`` is, the tests that compare with the authors' numbers are
run by themselves, too: the last column tells which of them notices.
"""

from __future__ import annotations

import argparse
import importlib
import os
import re
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from benchmarks.tables import publish, to_file

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Mutation:
    """``old``, which occurs in a file, becomes ``new``; ``tests`` should notice."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def _of(file: str, tests: str, *changes: tuple[str, str]) -> list[Mutation]:
    names = tuple(f"tests/tco/test_{name}.py" for name in tests.split())
    return [Mutation(file, old, new, names) for old, new in changes]


FUSION = ("tests/colmap_tco/test_fusion_gaps.py", "tests/colmap_tco/test_fusion.py")

MUTATIONS = [
    *_of(
        "tco/geometry.py",
        "geometry",
        ("device=like.device) + 0.5,\n        torch", "device=like.device),\n        torch"),
        ("ray = (xy - centre) / f", "ray = (xy - centre + 0.5) / f"),
        ("return xy * f + K", "return xy * f - K"),
        ("-Rt @ t", "Rt @ t"),
        ("a * W + b * (W @ W)", "a * W - b * (W @ W)"),
        ("(1 - torch.cos(theta)) / theta**2", "(1 - torch.cos(theta)) / theta"),
        ("return s, my - s * mx", "return s, my + s * mx"),
        ("align_corners=False", "align_corners=True"),
        ("h - f, c - g, d - b,\n        h - f", "h - f, c - g, b - d,\n        h - f"),
    ),
    *_of(
        "tco/backbones/decoder.py",
        "sweep",
        ("keepdim=True) > DOUBT", "keepdim=True) < DOUBT"),
        ("(3, 1, 1), 1, (1, 0, 0)).squeeze", "(1, 1, 1), 1, (0, 0, 0)).squeeze"),
    ),
    *_of(
        "tco/backbones/prefix.py",
        "prefix",
        ("return start + min(", "return start + max("),
        ("if p.isdigit()), 0)", "if p.isdigit()), 1)"),
    ),
    *_of(
        "tco/backbones/vggt.py",
        "prefix",
        ("range(passed.depth, c.depth)", "range(0, c.depth)"),
        ("kept[i] = torch.cat([frame, x], -1)", "kept[i] = torch.cat([x, frame], -1)"),
    ),
    *_of("tco/backbones/pi3.py", "prefix", ("Passed(depth, x)", "Passed(0, x)")),
    *_of(
        "tco/surfels.py",
        "surfels",
        ("+ (config.pixel_centre - 0.5)", "+ config.pixel_centre"),
        ("up = -down", "up = down"),
        ("torch.linalg.cross(normal, t_u)", "torch.linalg.cross(t_u, normal)"),
        ("radii = config.radius_factor * torch.cat", "radii = 2 * config.radius_factor * torch.cat"),
        ("radii * normal[..., 2:].abs()", "radii / normal[..., 2:].abs()"),
        ("1 - 1 / confidence.clamp_min(1 + 1e-6)", "1 / confidence"),
        ("quat_from_matrix(world_from_cam[:3, :3] @", "quat_from_matrix(world_from_cam[:3, :3].T @"),
        ("keep[:, :-1] &= valid[:, 1:]", "keep[:, :-1] &= valid[:, :-1]"),
        ("frame @ so3_exp(adjust.turn)", "so3_exp(adjust.turn) @ frame"),
    ),
    *_of(
        "tco/render/project.py",
        "render",
        ("w.new_tensor([1.0, 1.0, -1.0])", "w.new_tensor([1.0, 1.0, 1.0])"),
        ("surfels.scales.to(exact).unsqueeze(-2)", "surfels.scales.flip(-1).to(exact).unsqueeze(-2)"),
        ("exact = exact or surfels.means.dtype", "exact = surfels.means.dtype"),
        ("r2 = 2 * torch.log", "r2 = torch.log"),
        ("centres - filtered) - 0.51", "centres - filtered) + 0.51"),
        ("depths > near", "depths > -near"),
    ),
    *_of(
        "tco/render/kernels.py",
        "render",
        ("row[6]), -(box[0] + 0.5), W)", "row[6]), -box[0], W)"),
        ("row[10] - box[2] - 0.5, limit", "row[10] - box[2], limit"),
        ("filtered = 2 * (dx * dx + dy * dy)", "filtered = dx * dx + dy * dy"),
        ("min(row[12] * math.exp(-0.5 * s), MAX", "min(row[12] * math.exp(-s), MAX"),
        ("g_alpha = left[1] * value - left[0]", "g_alpha = left[1] * value + left[0]"),
        ("dW = _add(_cross(gx, Y), 1, _cross(X, gy))", "dW = _add(_cross(gx, Y), -1, _cross(X, gy))"),
        ("-(corner[0] + 0.5), dX)", "-corner[0], dX)"),
        ("grad[10] += g_alpha * alpha * 2 * (y - my)", "grad[10] += g_alpha * alpha * (y - my)"),
        ("grad[9] += value * weight * 2 * (x - mx)", "grad[9] -= value * weight * 2 * (x - mx)"),
        ("if s <= 2 * CORE:", "if s <= CORE:"),
        ("if not abs(row[11] - near) < tolerance * near:", "if not abs(row[11] - near) < tolerance:"),
    ),
    *_of(
        "tco/render/twin.py",
        "render",
        ("offset = pixels.unsqueeze(1) -", "offset = pixels.unsqueeze(1) + 0.5 -"),
        ("return 0.5 * torch.minimum((uv**2).sum(-1)", "return torch.minimum((uv**2).sum(-1)"),
    ),
    *_of(
        "tco/penalties.py",
        "penalties",
        ("invert(world_from_cam[:1]) @ world_from_cam", "world_from_cam @ invert(world_from_cam[:1])"),
        ("dim2=-1).sum(-1) - 1) / 2", "dim2=-1).sum(-1) - 1)"),
        (".norm(dim=-1).sum() / len(centres)", ".norm(dim=-1).sum() / (len(centres) - 1)"),
        ("(2 * (error[0, 0] + error[1, 1])", "((error[0, 0] + error[1, 1])"),
        ("confidence[mask].log()).mean()", "confidence[mask].log()).sum()"),
        ("return inverse * sparse.depth - 1, inside", "return 1 - inverse * sparse.depth, inside"),
        ("xy = torch.minimum(sparse.xy.clamp_min(0.5)", "xy = torch.minimum(0.5 + sparse.xy.clamp_min(0.5)"),
        ("robust(error / sigma, config.kernel", "robust(error * sigma, config.kernel"),
        ("(points.sigma**2 + config.sigma_floor**2)", "(points.sigma**2 - config.sigma_floor**2).abs()"),
        ("0.5 * threshold**2 * torch.log1p", "threshold**2 * torch.log1p"),
        ("robust(angle / (sigma[1:] ** 2 + sigma[0] ** 2).sqrt()", "robust(angle / sigma[1:]"),
        ("(scale * ours - theirs) / variance.sqrt()", "(scale * ours - theirs) / variance"),
        ("/ _focals(prior)).log() / sigma", "/ _focals(prior)).log() * sigma"),
        ("difference.sum(-1).mean()", "difference.mean()"),
        ("(ours / scales[0] - theirs / scales[1])", "(ours / scales[1] - theirs / scales[0])"),
    ),
    *_of(
        "tco/objective.py",
        "objective",
        ("limit = (1 + config.occlusion_tolerance)", "limit = (1 - config.occlusion_tolerance)"),
        ("counted = rendered.depth.detach() <= limit", "counted = rendered.depth.detach() >= limit"),
        ("(weight * error).sum() / weight.sum()", "(weight * error).mean()"),
        ("color / rendered.alpha.clamp_min", "color * rendered.alpha.clamp_min"),
        ("return gain, mean_image - gain * mean_color", "return gain, mean_image + gain * mean_color"),
        ("(1 - config.structure) * error +", "error +"),
        ("error = error + (ours - theirs).abs()", "error = error + 2 * (ours - theirs).abs()"),
    ),
    *_of(
        "tco/warping.py",
        "warping",
        ("ratio=z * found[:, 0]", "ratio=z / found[:, 0]"),
        ("invert(cameras.world_from_cam[chosen]) @", "cameras.world_from_cam[chosen] @"),
        ("detach() > 1 + config.occlusion", "detach() < 1 + config.occlusion"),
        ("weight = opacity * (warped.valid", "weight = 1.0 * (warped.valid"),
    ),
    *_of(
        "tco/consensus.py",
        "consensus",
        ("factor = 1 + (surface - z) / depth", "factor = surface / z"),
        ("there[:, 1] * (depth / z) * asked", "there[:, 1] * asked"),
        ("there[:, 1] * (depth / z) * asked", "(depth / z) * asked"),
        ("counts = (views.valid & known & smooth(depth))", "counts = (views.valid & known)"),
        ("counts = (views.valid & known & smooth(depth))", "counts = (known & smooth(depth))"),
        ("asked.where(known[view], moved[view])", "asked"),
        ("for view in views.wanted:", "for view in range(len(views)):"),
        ("torch.log(own / depth)[None]", "torch.zeros_like(own)[None]"),
        ("range(config.consensus_rounds)", "range(1)"),
        ("(there[:, 2] > ALL)", "(there[:, 2] > 0.5)"),
        ("(surface < high * z)", "(surface < 100 * z)"),
        ("weights / (1 + (off / width) ** 2)", "weights"),
        ("half = 1 - HALF if upper else HALF", "half = 0.9"),
        ("SIGMA_OF_MAD * weighted_median", "weighted_median"),
        ("OF_MEDIAN * count.sqrt()", "count.sqrt()"),
        ("(count - 0.8)", "count"),
        ("upper=True", "upper=False"),
        ("off = (values - middle).abs()", "off = values.abs()"),
        ("weights.sum(0) ** 2 / (weights**2).sum(0)", "(weights > 0).sum(0) / torch.ones(()).double()"),
        ("spread.where(known[view], error[view])", "spread"),
        ("config.consensus_views)", "100)"),
        ("stages=())", "stages=prediction.stages)"),
    ),
    *(
        Mutation(file, old, new, FUSION)
        for file, old, new in (
            ("colmap_tco/_vote_kernels.py", "(ratio if flat else _1) -", "_1 -"),
            ("colmap_tco/_vote_kernels.py", "x = (tile[COL + m] + _HALF - cx) * ifx * z",
             "x = (tile[COL + m] - cx) * ifx * z"),
            ("colmap_tco/_vote_kernels.py", "dx - here_x * dz", "dx + here_x * dz"),
            ("colmap_tco/_vote_kernels.py", "through if off > _0", "through if off < _0"),
            ("colmap_tco/_fusion_gaps.py", "(depth_error, 0.5)", "(depth_error, 0.0)"),
            ("colmap_tco/_fusion_gaps.py", "(points - centre(view)) @", "(points + centre(view)) @"),
            ("colmap_tco/_fusion_gaps.py", "self._near[j].add(i)", "self._near[j].add(j)"),
            ("colmap_tco/_fusion_shelf.py", "taken[unsure] = 1", "packed[unsure, 0] = 0"),
            ("colmap_tco/_fusion_shelf.py", "taken[unsure] = 1", "taken[unsure] = 0"),
            ("colmap_tco/_fusion_shelf.py", "((maps.error > 0) &", "((maps.error >= 0) &"),
            ("colmap_tco/_fusion_shelf.py", "if position not in self._taken:", "if position in self._taken:"),
            ("colmap_tco/fusion.py", "max_agreed_error > 0 and", "max_agreed_error >= 0 and"),
            ("colmap_tco/fusion.py", "max_agreed_error > 0 and covered:", "max_agreed_error > 0:"),
            ("colmap_tco/fusion_report.py", "kept[kept >= count] - count", "kept[kept >= count]"),
            ("colmap_tco/_fusion_reference.py", 'valid - found - own.dropped.get("max_agreed_error", 0)',
             "valid - found"),
        )
    ),
    *_of(
        "tco/linearise.py",
        "poses",
        ("_cross(x, in_source), in_world", "_cross(in_source, x), in_world"),
        ("_cross(by_point, X), -in_world", "_cross(by_point, X), in_world"),
        ("torch.cat([-over_z, (own +", "torch.cat([-over_z, (own -"),
        ("zoom = -(in_source[:2] * x[:2]).sum(0) -", "zoom = -(in_source[:2] * x[:2]).sum(0) +"),
        ("(offset @ in_world)", "(-offset @ in_world)"),
    ),
    *_of(
        "tco/polish.py",
        "polish",
        ('mode="bilinear", align_corners=False', 'mode="bilinear", align_corners=True'),
        ("torch.exp(-across / EDGE)", "torch.exp(across / EDGE)"),
        ("down * field.diff(dim=0).abs()", "0 * field.diff(dim=0).abs()"),
        ('weights["warped"] = weights.pop("photometric")', 'weights.pop("photometric")'),
        ("self.prediction.depth[chosen] * factor", "self.prediction.depth[chosen] * factor.detach()"),
        ("self.now.depth[seen] = self.refined(seen).depth", "self.now.depth[seen] *= 1"),
        ("view * len(self.levels) + i", "view + i * len(self.levels)"),
    ),
    *_of(
        "tco/ssim.py",
        "ssim",
        ("smooth(a * b, window) - both", "smooth(a * b, window) + both"),
        ("SIGMA = 1.5", "SIGMA = 1.6"),
        ("C1, C2 = 0.01**2, 0.03**2", "C1, C2 = 0.01, 0.03**2"),
        ("inner[:, 1 : p + 1] +=", "inner[:, :p] +="),
        ("cv2.BORDER_CONSTANT", "cv2.BORDER_REFLECT_101"),
    ),
    *_of(
        "tco/corrections.py",
        "corrections",
        ("pose[:, :3, :3] @ so3_exp(self.turn * rotation", "pose[:, :3, :3] @ so3_exp(-self.turn * rotation"),
        ("t = pose[:, :3, 3] + self.shift", "t = pose[:, :3, 3] - self.shift"),
        ("torch.exp(self.zoom * focal)\n", "torch.exp(2 * self.zoom * focal)\n"),
        ("torch.stack([factor, factor, torch.ones_like(factor)]", "torch.stack([factor, factor, factor]"),
        (".sum(0).mean()", ".sum()"),
    ),
    *_of(
        "tco/lora.py",
        "lora",
        ("(b * scale).to(x.dtype)", "b.to(x.dtype)"),
        ("inner(x, weight + delta", "inner(x, weight - delta"),
        ("tensor.copy_(value)", "pass"),
    ),
    *_of(
        "tco/schedule.py",
        "schedule",
        ("odds[source] = 0", "odds[source] = 1"),
        ("odds.fill_diagonal_(0)", "pass"),
        ("key=lambda view: view not in drawn", "key=lambda view: view in drawn"),
        ("self.best, self.waited = average, 0", "self.best = average"),
    ),
    *_of(
        "tco/optimize.py",
        "toy optimize",
        ("return self.corrections()", "return self.encoded_cameras"),
        ("return corrections.pixels(", "return 0.0 * corrections.pixels("),
        ("if loss < self.best_loss:", "if loss > self.best_loss:"),
        ("self.terms.sparse[s][shown] for", "self.terms.sparse[s][~shown] for"),
    ),
    *_of(
        "tco/terms.py",
        "terms toy optimize",
        ("if weight > 0}", "}"),
        ("getattr(known, name) * penalties.held", "penalties.held"),
        ("mask = (self.depth > 0)", "mask = (self.depth >= 0)"),
        ("known = prediction if len", "known = context if len"),
        ("pixel_centre=0.0, confident", "pixel_centre=0.5, confident"),
        ("penalties.depth(every, self.depth, mask, chosen)", "penalties.depth(every, self.depth, mask)"),
    ),
    *_of("tco/options.py", "toy", ("        3e-4,\n", "        1.0,\n")),
    *_of("tco/options.py", "prefix", ('source_order="uniform", run_ahead=False', 'source_order="uniform"')),
    *_of("tco/optimize.py", "prefix", ("if self.config.ablation.run_ahead and", "if")),
    *_of("tco/objective.py", "objective", ("match_exposure(color.detach()", "match_exposure(color")),
    *_of("tco/backbones/sweep.py", "sweep", ("self.dtype or compute_dtype(", "compute_dtype(")),
    *_of(
        "tco/align.py",
        "align",
        ("return cls(config.camera_weight, by", "return cls(config.rate, by"),
        ("*sigmas, kernel=self.kernel)", "*sigmas)"),
    ),
]  # fmt: skip


NO_TESTS = 5
"""Status of pytest where a selection holds no test."""


def copy_tree(work: Path) -> None:
    """What the tests need, in a folder beside a link to the published numbers."""
    for name in ("tco", "colmap_tco", "tests", "training", "benchmarks"):
        shutil.copytree(ROOT / name, work / "tree" / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", work / "tree")
    shared = ROOT.parent / "shared"
    if shared.is_dir():
        os.symlink(shared, work / "shared")


def first_failure(tree: Path, mutation: Mutation, only: str = "") -> str | None:
    """Name of the first test that fails, None if all pass; of those alone that ``only`` selects (``-k``).

    The tests run in a fork of this process, which has loaded what takes long to load.

    Raises:
        SystemExit: the tests could not be run at all.
    """
    log = tree / "log.txt"
    process = get_context("fork").Process(target=_run_tests, args=(tree, mutation, log, only))
    process.start()
    process.join()
    if process.exitcode == 0 or (only and process.exitcode == NO_TESTS):
        return None
    text = log.read_text(encoding="utf-8")
    found = re.search(r"^(?:FAILED|ERROR) \S*?(test_\w+\.py\S*)", text, re.MULTILINE)
    if process.exitcode != 1 or not found:
        sys.exit(f"the tests could not be run:\n{text[-2000:]}")
    return found[1]


def _run_tests(tree: Path, mutation: Mutation, log: Path, only: str) -> None:
    """In the fork: run the tests of a mutation in the copy, and end with pytest's status."""
    import pytest

    # Compiled code is found by the date of its file, which a change within a second may not alter.
    cache = tree / (f"cache-{time.monotonic_ns()}" if "kernels" in mutation.file else "cache")
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
    sys.dont_write_bytecode = True
    os.chdir(tree)
    sys.path[:] = [str(tree), *(entry for entry in sys.path if entry not in ("", str(ROOT)))]
    for name in [name for name in sys.modules if name.split(".")[0] == "benchmarks"]:
        del sys.modules[name]
    with log.open("w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        status = pytest.main(
            ["-q", "-x", "-rfE", "--no-header", "-p", "no:cacheprovider", "-k", only, *mutation.tests]
        )
        sys.stdout.flush()
    os._exit(int(status))


def code(text: str) -> str:
    """Text as code in a cell of a Markdown table."""
    line = " ".join(text.split()).replace("|", "\\|")
    return f"`{line}`"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", default="", help="parts of file names, separated by commas")
    to_file(parser)
    args = parser.parse_args()
    wanted = [word for word in args.only.split(",") if word]
    chosen = [m for m in MUTATIONS if not wanted or any(word in m.file for word in wanted)]
    # Loaded once, for all forks: a single thread, which a fork can take along.
    importlib.import_module("torch").set_num_threads(1)
    rows, missed, by_numbers = [], 0, 0
    with tempfile.TemporaryDirectory() as folder:
        copy_tree(Path(folder))
        tree = Path(folder) / "tree"
        for mutation in chosen:
            path = tree / mutation.file
            original = path.read_text(encoding="utf-8")
            if mutation.old not in original:
                sys.exit(f"{mutation.file} does not hold {mutation.old!r} any more: adapt the list")
            path.write_text(original.replace(mutation.old, mutation.new, 1), encoding="utf-8")
            caught, parity = first_failure(tree, mutation), first_failure(tree, mutation, "parity")
            path.write_text(original, encoding="utf-8")
            missed += caught is None
            by_numbers += parity is not None
            change = f"{code(mutation.old)} | {code(mutation.new)}"
            rows.append(f"| {mutation.file} | {change} | {caught or '**not noticed**'} | {parity or ''} |")
            sys.stderr.write(rows[-1] + "\n")
    text = (
        f"# Mutations\n\n`python -m benchmarks.mutations`: {len(chosen) - missed} of {len(chosen)} changes "
        "are noticed; the first test that fails is named. The tests against the authors' numbers alone (the "
        f"last column) notice {by_numbers}; they do not reach what the published code does not have.\n\n"
        "| file | from | to | noticed by | by the authors' numbers |\n|---|---|---|---|---|\n"
    )
    text += "\n".join(rows) + "\n"
    publish(text, args.output, args.part)
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
