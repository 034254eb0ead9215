"""What a run makes its result from: the settings that decide it, and the bytes of its inputs.

Where a workspace lies and when its files were written decide nothing, so that a copy of it is as good as
the original. Nor do the versions of libraries count, which change results by rounding; the report has them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_tco import report
from colmap_tco.backbones import Selected
from colmap_tco.fill import Existing
from colmap_tco.flags import settings
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.mapping import MappingConfig
from colmap_tco.outputs import plain
from colmap_tco.resume import Origin
from colmap_tco.views import View
from colmap_tco.workspace import Workspace

if TYPE_CHECKING:
    from colmap_tco.densify import DensifyConfig

HASHED = 200_000_000
"""Bytes below which a file of weights counts by its content, above by its size and time of change."""

LATER = frozenset({"refine_cameras", *(setting.name for setting in settings(FusionConfig))})
"""Settings that decide only what is made of the depth maps."""

IN_THE_INPUTS = frozenset(
    {
        *("image_path", "model_path", "mask_path", "fill_only", "weights"),
        *(setting.name for setting in settings(MappingConfig)),
    }
)
"""Settings that say where the inputs are or how the model was made: what they led to counts, in its bytes."""

FREE = frozenset({"given", "overwrite", "report_page", "num_threads", "cache_size"})
"""Settings that do not change the result."""

_BLOCK = 1 << 20


def origin_of(
    workspace: Workspace, views: Sequence[View], config: DensifyConfig, chosen: Selected,
    existing: Existing | None = None,
) -> Origin:  # fmt: skip
    """What this run would make its result from.

    Args:
        workspace: whose model is used, which there is by now.
        views: that are used, with their pictures and masks.
        config: of the run, with the network's own settings in it.
        chosen: network, weights and device.
        existing: depth maps to complete, if any.
    """
    given = {k: v for k, v in _flat(plain(config)).items() if k not in IN_THE_INPUTS | FREE}
    resolved = {
        "backbone": chosen.network.name,
        "device": chosen.device.type,
        "max_image_size": config.views.max_image_size or chosen.network.image_size,
        "colmap-tco": ".".join(report.versions()["colmap-tco"].split(".")[:2]),
    }
    model = [path for path in workspace.model_path.iterdir() if path.suffix in (".bin", ".txt")]
    files = {f"model {path.name}": path for path in sorted(model)}
    files |= {f"picture {view.name}": view.path for view in views}
    files |= {f"mask {view.name}": view.mask_path for view in views if view.mask_path is not None}
    if existing:
        files |= {f"fill_only {path.relative_to(existing.paths.root)}": path for path in existing.files()}
    status = chosen.weights.stat()
    large = {}
    if status.st_size < HASHED:
        files["weights"] = chosen.weights
    else:
        large["weights"] = f"{chosen.weights.name} {status.st_size} {status.st_mtime_ns}"
    return Origin(given | resolved, hashes(files) | large, LATER)


def hashes(files: Mapping[str, Path]) -> dict[str, str]:
    """Label → SHA-256 of the bytes of each file; 1 to 2 GB a second, much less than decoding takes."""
    with ThreadPoolExecutor() as pool:
        return dict(zip(files, pool.map(_hash, files.values()), strict=True))


def _hash(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _flat(nested: object) -> dict[str, object]:
    """Settings by name, those of nested groups among them; their names are all different."""
    found: dict[str, object] = {}
    for name, value in nested.items() if isinstance(nested, dict) else ():
        found |= _flat(value) if isinstance(value, dict) else {name: value}
    return found
