"""One row on one scene: what is given, what is optimised, and the points and poses that come out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from colmap_tco.bench.prepare import Prepared, unproject
from colmap_tco.bench.rows import Row
from colmap_tco.datasets.base import Floats
from colmap_tco.errors import InputError
from colmap_tco.fusion_config import FusionConfig
from colmap_tco.outputs import FEWEST_POINTS, NEARLY_ALL
from tco.align import CameraPenalties, KnownCameras
from tco.backbones.base import Backbone
from tco.lora import select
from tco.optimize import Outcome, optimize
from tco.options import TCOConfig
from tco.penalties import in_first_view
from tco.types import Cameras, HeldCameras, Prediction, Priors, SparseDepth, Views

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


@dataclass(frozen=True)
class Reconstruction:
    """What a row gives of a scene.

    Attributes:
        points: (V, H, W, 3), in the frame and unit of the network or of the prior cameras.
        world_from_cam: (V, 4, 4), likewise.
        loss: of the last step; None without steps.
        kept: (V, H, W), the pixels whose points count; None: all. With sparse points among the priors
            those that are too deep are left out, as the fusion leaves them out of clouds
            (``max_depth_ratio``): a few in a thousand that are taken for sky would decide the alignment, a
            sum of squares.
    """

    points: Floats
    world_from_cam: Floats
    loss: float | None
    kept: NDArray[np.bool_] | None = None


def check_row(network: Backbone, row: Row) -> None:
    """Whether a network can run a row at all.

    Raises:
        InputError: it cannot; the message says what it can.
    """
    where = f"--rows {row.name}"
    if network.uses_cameras and not {"pose", "intrinsics"} <= set(row.priors):
        raise InputError(
            f"{where}: {network.name} takes poses and intrinsics as input and predicts neither; it can run "
            "tco, adapt-only, no-compatibility, rank=, radius=, heads, surfels, steps= and noise= with "
            "--priors pose,intrinsics (steps=0 is the network alone)"
        )
    if network.uses_cameras and row.name == "raw-depth":
        raise InputError(f"{where}: {network.name} takes the cameras as input; its own depths are steps=0")
    if row.cameras and not {"pose", "intrinsics"} <= set(row.priors):
        raise InputError(f"{where} takes the prior cameras: give --priors pose,intrinsics")


def check_settings(row: Row, config: TCOConfig) -> None:
    """Whether the settings of a run, as the row changes them, make use of its priors, and are all of use.

    Raises:
        InputError: they do not, or are not.
    """
    config = row.config(config)
    if config.own_cameras != "published":
        raise InputError(
            f"--own_cameras {config.own_cameras}: the cameras of a dataset have no standard deviations"
        )
    if "depth" in row.priors and config.steps and not config.depth_weight:
        raise InputError(
            f"--rows {row.name} has depths as priors, which count for nothing: give --depth_weight"
        )


def reconstruct(
    network: Backbone, scene: Prepared, row: Row, config: TCOConfig, device: torch.device, seed: int = 0
) -> Reconstruction:
    """Run a row; the network is left as it was.

    Args:
        network: on ``device``.
        scene: the views and the priors.
        row: what to do.
        config: settings of the run, which the row changes.
        device: where to compute.
        seed: of the noise and of the optimisation.

    Raises:
        InputError: the network cannot run the row, or its priors count for nothing.
        ValueError: there is nothing to optimise, or the cameras of the scene determine no scale.
    """
    check_row(network, row)
    check_settings(row, config)
    config, cameras = row.config(config), row.noise.cameras(scene.cameras, seed)
    backbone = _with_heads(network) if row.heads else network
    if row.heads:
        config = _heads(config, backbone)
    views = scene.views.to(device)
    if network.uses_cameras:
        assert scene.priors is not None
        priors = row.noise(scene.priors, seed).to(device)
        outcome = optimize(backbone, views, priors, config, seed)
        return replace(_result(outcome, scene.unit), kept=_near(outcome, scene.priors))
    if row.cameras:
        return _with_cameras(backbone, views, cameras.to(device), row, config, seed)
    priors = held_priors(scene, cameras, row).to(device) if config.steps else Priors()
    return _result(optimize(backbone, views, priors, config, seed))


def held_priors(scene: Prepared, cameras: Cameras, row: Row) -> Priors:
    """The priors of a row as penalties: prior cameras (V) with the published weights, or depths."""
    weights = CameraPenalties()
    # One view has no relative pose; the published penalties are 0 then.
    posed = "pose" in row.priors and len(cameras) > 1
    held = HeldCameras(
        cameras,
        rotation=weights.rotation if posed else 0.0,
        translation=weights.translation if posed else 0.0,
        focal=weights.focal if "intrinsics" in row.priors else 0.0,
    )
    depth = torch.from_numpy(scene.depth) if "depth" in row.priors else None
    return Priors(depth=depth, held=held)


def _with_cameras(
    network: Backbone, views: Views, cameras: Cameras, row: Row, config: TCOConfig, seed: int
) -> Reconstruction:
    """The network's depths in the prior cameras; then, for surfels, optimised without the network."""
    first = optimize(network, views, Priors(), replace(config, steps=0)).prediction
    scaled = rescaled(cameras, first.cameras)
    if not row.surfels or len(views) == 1:  # one view has no other that its surfels could be compared with
        return _result(Outcome(replace(first, cameras=scaled, rays=None), scaled))
    none = views.images.new_zeros(0)
    empty = SparseDepth(none.reshape(0, 2), none, none, none.long())
    alike = torch.ones(len(views), len(views)).fill_diagonal_(0).to(views.images)
    priors = Priors(cameras=scaled, sparse=(empty,) * len(views), overlap=alike)
    config = replace(config, camera_rate=0.0)
    return _result(optimize(KnownCameras(network), views, priors, config, seed))


def rescaled(cameras: Cameras, predicted: Cameras) -> Cameras:
    """The prior cameras (V) in the frame of their first, as far from it on average as the predicted ones.

    The published code's ``forward_original_vggt`` has the same, for the row with raw depths. One view, or
    views at one place, are left as they are.
    """
    ours, theirs = (in_first_view(c.world_from_cam) for c in (cameras, predicted))
    wanted, now = (pose[:, :3, 3].norm(dim=-1).mean() for pose in (theirs, ours))
    pose = ours.clone()
    if float(now) > 0:
        pose[:, :3, 3] *= wanted / now
    return Cameras(pose, cameras.K)


def _result(outcome: Outcome, unit: float = 1.0) -> Reconstruction:
    """Points of the depths in the cameras as they are believed at the end; of a point map, its own."""
    prediction, cameras = outcome.prediction.to("cpu"), outcome.cameras.to("cpu")
    K, poses = cameras.K.double().numpy(), cameras.world_from_cam.double().numpy()
    rays = None if prediction.rays is None else prediction.rays.double().numpy()
    points = unproject(prediction.depth.float().numpy(), K, poses, rays) * unit
    poses[:, :3, 3] *= unit
    loss = outcome.history[-1].get("loss") if outcome.history else None
    return Reconstruction(points, poses, loss)


def _near(outcome: Outcome, priors: Priors) -> NDArray[np.bool_]:
    """Pixels (V, H, W) that are no deeper than the fusion takes them, by the points of their view."""
    assert priors.sparse is not None
    most = FusionConfig().max_depth_ratio
    bounds = [
        most * float(points.depth.quantile(NEARLY_ALL)) if len(points) >= FEWEST_POINTS else np.inf
        for points in priors.sparse
    ]
    depth = outcome.prediction.depth.float().cpu().numpy()
    return np.asarray(depth <= np.array(bounds, np.float32)[:, None, None])


class _WithHeads(nn.Module):
    """A network whose decoder has its heads, too."""

    def __init__(self, network: Any, heads: nn.ModuleDict) -> None:
        super().__init__()
        self.network, self.heads = network, heads
        self.name, self.stride, self.uses_cameras = network.name, network.stride, network.uses_cameras

    def decoder(self) -> nn.Module:
        """The decoder as ``blocks``, then the heads."""
        return nn.ModuleDict({"blocks": self.network.decoder(), "heads": self.heads})

    def encode(self, views: Views, priors: Priors) -> Any:
        """The network's."""
        return self.network.encode(views, priors)

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """The network's."""
        prediction: Prediction = self.network.decode(encoded, views, context)
        return prediction

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        """The network's."""
        return self.network.with_points(encoded, points)


def _with_heads(network: Any) -> Backbone:
    """The network with its heads as part of the decoder; as it is, where they are part of it already.

    Heads are the modules beside the decoder whose names end in ``head``; VGGT's for points is left out, since
    points are made of depths.
    """
    inner = getattr(network, "network", None)
    if not isinstance(inner, nn.Module):
        return network
    inside = {id(module) for module in network.decoder().modules()}
    unused = ("point_head",) if network.name == "vggt" else ()
    heads = {
        name: module
        for name, module in inner.named_children()
        if name.endswith("head") and id(module) not in inside and name not in unused
    }
    return _WithHeads(network, nn.ModuleDict(heads)) if heads else network


def _heads(config: TCOConfig, network: Backbone) -> TCOConfig:
    """Heads trained in full at a rate of their own, and adapters on the rest of the decoder at its rate."""
    decoder = network.decoder()
    if isinstance(network, _WithHeads):
        chosen = tuple(name for name in select(decoder, config.lora_targets) if name.startswith("blocks."))
        unfrozen: tuple[str, ...] = ("heads.*",)
    else:
        chosen = config.lora_targets
        found = [name for name, _ in decoder.named_modules() if name.split(".")[-1].endswith("head")]
        unfrozen = tuple(found) or (list(select(decoder, ("*",)))[-1],)
    return replace(config, lora_targets=chosen, ablation=replace(config.ablation, unfrozen=unfrozen))
