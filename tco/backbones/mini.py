"""``mini``: a VGGT of eight million parameters, which takes images alone and predicts depths and cameras.

The network is :class:`tco.backbones.vggt.VGGTNetwork` with small sizes, patches of 8 pixels, and no head for
points; nothing of it is published, it is trained in this repository (``training/train_mini.py``). It makes
the claim of arXiv 2604.03878, on networks that find their own cameras, testable without foreign weights.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import nn

from tco.backbones.checkpoints import NETWORK, load_network, save
from tco.backbones.dinov2 import ViTConfig
from tco.backbones.transformer import LayerScale, compute_dtype
from tco.backbones.vggt import VGGT, VGGTConfig, VGGTNetwork
from tco.backbones.vggt_heads import POSE_CHANNELS
from tco.backbones.weights import WeightsError

MINI = VGGTConfig(
    ViTConfig(channels=192, depth=0, heads=6, side=12, mask_token=False, patch=8),
    channels=192, depth=6, heads=6, registers=4, camera_depth=1, camera_heads=6,
    features=48, levels=(48, 64, 80, 80), layers=(1, 2, 4, 5), points=False,
)  # fmt: skip
"""Sizes of the network: fewer than 2²³ parameters, 16.8 MB in half precision.

Its encoder is the embedding of patches alone: attention within a view is what the frame blocks have, and
those can be adapted.
"""


class Mini(VGGT):
    """The backbone; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "mini"


@torch.no_grad()
def fresh(config: VGGTConfig = MINI, seed: int = 0) -> VGGTNetwork:
    """A network to be trained from nothing.

    Published checkpoints replace every parameter, so :class:`VGGTNetwork` starts where none could learn:
    tokens of zeros are all alike, and residual branches scaled by 0.01 are for a trained encoder. Here tokens
    and positions are normal with a deviation of 0.02, branches count in full, and the first prediction is
    whatever the inputs: no motion, fields of view of half a radian or so, a depth of 1 and a confidence of 2.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = VGGTNetwork(config)
        a, c = network.aggregator, network.camera_head
        e = a.patch_embed
        for token in (a.camera_token, a.register_token, e.cls_token, e.pos_embed, e.register_tokens):
            token.normal_(0, 0.02)
    for module in network.modules():
        if isinstance(module, LayerScale):
            module.gamma.fill_(1.0)
    last = c.pose_branch.fc2
    last.weight.mul_(0.1)
    # Four iterations add up: after them the quaternion's real part and the angles are 0.4 to 1.6 times these.
    last.bias.copy_(torch.tensor([0.0] * 6 + [0.4] * (POSE_CHANNELS - 6)))
    maps = network.depth_head.scratch.output_conv2[-1]
    assert isinstance(maps, nn.Conv2d) and maps.bias is not None
    maps.weight.mul_(0.1)
    maps.bias.zero_()
    return network


def write(path: Path, network: VGGTNetwork) -> None:
    """Write weights as safetensors in half precision, with the network's sizes and name.

    Raises:
        ValueError: a weight is not finite in half precision.
    """
    half = VGGTNetwork(network.config)
    half.load_state_dict(network.state_dict())
    half.half()
    wrong = [name for name, tensor in half.state_dict().items() if not bool(torch.isfinite(tensor).all())]
    if wrong:
        raise ValueError(f"weights that half precision cannot hold: {', '.join(wrong[:3])}")
    save(path, half, network.config, {NETWORK: Mini.name})


def load(
    path: Path,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
    recompute: range = range(0),
) -> Mini:
    """The network with the weights of a file that :func:`write` wrote, frozen and in evaluation mode.

    Args:
        path: its sizes are in its metadata.
        device: where it runs.
        dtype: of the matrix products; None: what the device multiplies fastest.
        recompute: see :class:`tco.backbones.vggt.VGGT`.

    Raises:
        WeightsError: the file is missing, damaged, or of another network.
    """
    network = load_network(path, VGGTNetwork, MINI)
    if network.config.points:
        raise WeightsError(f"{path}: weights of a VGGT with a head for points; --backbone vggt takes those")
    place = torch.device(device)
    return Mini(network, dtype or compute_dtype(place), recompute).eval().requires_grad_(False).to(place)
