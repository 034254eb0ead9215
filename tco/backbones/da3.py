"""Depth Anything 3 (Lin et al. 2025, arXiv 2511.10647) as a backbone, around its authors' package.

The package declares requirements that the network does not import and that clash with those here (numpy < 2,
xformers, …), so it is installed without them: :data:`INSTALL`. Its modules are called one by one: its own
entry point runs under ``inference_mode``, and its forward pass neither keeps what comes before the adapted
layers nor decodes a part of the views.

- ``encode`` runs the first blocks, which see one view each, and what takes the place of the class token
  from then on: an encoding of the camera where the priors know it (normalised as the package's interface does
  it), else one learned token for the reference view and another for all others. The reference is the view
  that the package would choose. It sorts that view to the front and back again, which changes nothing but the
  order in which sums are taken, and is left out.
- ``decode`` runs the other blocks, which see one view and all views in turn; then, in float32, the
  depth head for the chosen views (its map of rays is not used) and the camera head for all.

Depth is camera z and the scale is the network's own. It predicts cameras also where they are known; their
principal point is in the middle, and that of known cameras is not told to the network.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from tco.backbones.checkpoints import load_network
from tco.backbones.dinov2 import PATCH, normalized, patch_grid
from tco.backbones.prefix import Passed, first_block
from tco.backbones.transformer import compute_dtype, computing, store_products
from tco.geometry import invert, matrix_from_quat, rigid
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

INSTALL = "pip install 'colmap-tco[da3]' && pip install --no-deps depth-anything-3==0.1.1"
"""How the package comes beside this one: without its own requirements."""

SMALLEST_SPREAD = 0.1
"""Least unit, in that of the cameras, by which the package divides their positions."""


@dataclass(frozen=True)
class DA3Config:
    """Sizes of the network.

    Attributes:
        channels, depth, heads: of the transformer.
        start: the first block that is adapted. From it on, even blocks see one view and odd ones all,
            with rotary positions and normalised queries and keys.
        layers: blocks whose tokens the depth head reads; the camera head reads the last.
        features, levels: channels of the depth head, after and before the fusion.
        side: patches along a side of the square images that the positions are stored for.
    """

    channels: int = 768
    depth: int = 12
    heads: int = 12
    start: int = 4
    layers: tuple[int, int, int, int] = (5, 7, 9, 11)
    features: int = 128
    levels: tuple[int, int, int, int] = (96, 192, 384, 768)
    side: int = 37

    def __post_init__(self) -> None:
        if self.start % 2 or self.layers[0] <= self.start or self.layers[-1] != self.depth - 1:
            raise ValueError("the first adapted block is even, and the heads read later ones and the last")

    @classmethod
    def base(cls) -> DA3Config:
        """The published DA3-BASE."""
        return cls()

    @classmethod
    def small(cls) -> DA3Config:
        """The published DA3-SMALL."""
        return cls(channels=384, heads=6, features=64, levels=(48, 96, 192, 384))


class DA3Network(nn.Module):
    """The package's ``DepthAnything3Net`` as its checkpoints name it, of any sizes.

    Raises:
        ModuleNotFoundError: the package, or what it imports, is not installed.
    """

    def __init__(self, config: DA3Config) -> None:
        super().__init__()
        self.config = config
        self.model = _assembled(config)

    @property
    def transformer(self) -> Any:
        """The package's vision transformer."""
        return self.model.get_submodule("backbone.pretrained")


def products(network: DA3Network) -> list[nn.Module]:
    """The blocks, whose matrix products are taken in the type of the device."""
    return [network.transformer.blocks]


def _assembled(c: DA3Config) -> nn.Module:
    """The package's network, with its messages of progress kept off the standard output."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # its way to register a resolver is deprecated in OmegaConf 2.4
            from depth_anything_3.model.cam_dec import CameraDec
            from depth_anything_3.model.cam_enc import CameraEnc
            from depth_anything_3.model.da3 import DepthAnything3Net
            from depth_anything_3.model.dinov2.dinov2 import DinoV2
            from depth_anything_3.model.dinov2.vision_transformer import DinoVisionTransformer
            from depth_anything_3.model.dualdpt import DualDPT
            from depth_anything_3.utils.logger import LOG_LEVELS, logger
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"Depth Anything 3 runs from its authors' package, and {error.name} is missing: {INSTALL}",
            name=error.name,
        ) from error
    if "DA3_LOG_LEVEL" not in os.environ:
        logger.level = LOG_LEVELS["WARN"]

    class Encoder(DinoV2):
        """The package's wrapper, which knows named sizes alone, with a transformer of any size."""

        def __init__(self) -> None:
            nn.Module.__init__(self)
            self.out_layers = list(c.layers)
            self.pretrained = DinoVisionTransformer(
                img_size=PATCH * c.side,
                patch_size=PATCH,
                embed_dim=c.channels,
                depth=c.depth,
                num_heads=c.heads,
                drop_path_uniform=True,
                alt_start=c.start,
                qknorm_start=c.start,
                rope_start=c.start,
            )

    head = DualDPT(2 * c.channels, features=c.features, out_channels=c.levels)
    return DepthAnything3Net(Encoder(), head, CameraDec(2 * c.channels), CameraEnc(c.channels))


@dataclass(frozen=True)
class Tokens:
    """What the first blocks make of V views.

    Attributes:
        tokens: (V, 1 + rows · columns, C); the first of each view says what is known of its camera.
        grid: rows and columns of patches.
        passed: the tokens behind the first of the other blocks, where those are computed once.
    """

    tokens: Tensor
    grid: tuple[int, int]
    passed: Passed | None = None

    def __len__(self) -> int:
        return int(self.tokens.shape[0])

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the canvas in pixels."""
        return PATCH * self.grid[0], PATCH * self.grid[1]


class DA3(nn.Module):
    """The backbone; satisfies :class:`tco.backbones.base.Backbone`."""

    name = "da3"
    stride = PATCH
    uses_cameras = False

    def __init__(
        self, network: DA3Network, dtype: torch.dtype = torch.float32, recompute: range = range(0)
    ) -> None:
        """Wrap a network.

        Args:
            network: with its weights; its blocks are converted to ``dtype``.
            dtype: float32 or bfloat16, of the matrix products of all blocks; the heads are float32.
            recompute: blocks whose activations are computed again in the backward pass. The attribute
                can be set at any time.
        """
        super().__init__()
        self.network, self.dtype, self.recompute = network, dtype, recompute
        store_products(products(network), dtype)

    @property
    def transformer(self) -> Any:
        """The package's vision transformer."""
        return self.network.transformer

    def decoder(self) -> nn.Module:
        """The blocks from the first on that sees the tokens of the cameras."""
        blocks: nn.ModuleList = self.transformer.blocks
        return nn.ModuleList(blocks[self.network.config.start :])

    @torch.no_grad()
    def encode(self, views: Views, priors: Priors) -> Tokens:
        """Tokens of all views after the first blocks, with the cameras of the priors if they have any.

        Raises:
            ValueError: no views, or a canvas that is not divisible by 14.
        """
        grid, vit = patch_grid(views), self.transformer
        with computing(views.images.device, self.dtype):
            x = vit.prepare_tokens_with_masks(normalized(views.images).unsqueeze(0))
            for i in range(self.network.config.start - 1):
                x = vit.process_attention(x, vit.blocks[i], "local")
            reference = _reference(x) if priors.cameras is None else 0
            x = vit.process_attention(x, vit.blocks[self.network.config.start - 1], "local")
        x = x[0].clone()
        if priors.cameras is None:
            first, other = vit.camera_token[0]
            x[:, 0] = other
            x[reference, 0] = first
        else:
            x[:, 0] = self._known(priors.cameras, views.size)
        return Tokens(x, grid)

    def _known(self, cameras: Cameras, size: tuple[int, int]) -> Tensor:
        """Tokens (V, C) of cameras, by the package's camera encoder."""
        cam_from_world = normalized_cameras(cameras.world_from_cam.float())
        with computing(cam_from_world.device, torch.float32):
            encoder: Any = self.network.model.cam_enc
            tokens: Tensor = encoder(cam_from_world.unsqueeze(0), cameras.K.float().unsqueeze(0), size)[0]
        return tokens

    def with_points(self, encoded: Tokens, points: Mapping[int, SparseDepth]) -> Tokens:
        """The same features: this network takes no points."""
        return encoded

    @torch.no_grad()
    def ahead(self, encoded: Tokens, changed: Collection[str]) -> Tokens:
        """The same, with the blocks before the first that changes behind it, an even number of them."""
        c = self.network.config
        depth = min(first_block(changed, c.depth - c.start, c.start), c.depth - 1) // 2 * 2
        x, kept = encoded.tokens, dict[int, Tensor]()
        with computing(encoded.tokens.device, self.dtype):
            for i, one, after in self._passing(encoded, Passed(c.start, x), depth):
                x = after
                if i in c.layers:
                    kept[i] = self._read(one, x)
        return replace(encoded, passed=Passed(depth, x, kept))

    def decode(
        self, encoded: Tokens, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Depth and confidence of some views, cameras of all; the context is not used."""
        chosen = tuple(range(len(encoded))) if views is None else tuple(views)
        with computing(encoded.tokens.device, self.dtype):
            dense, camera = self._features(encoded, chosen)
        with computing(encoded.tokens.device, torch.float32):
            model: Any = self.network.model
            maps = model.head([(x.unsqueeze(0), None) for x in dense], *encoded.size, patch_start_idx=0)
            cameras = self._cameras(camera, encoded.size)
        return Prediction(maps["depth"][0], maps["depth_conf"][0], cameras, chosen)

    def _features(self, encoded: Tokens, views: Sequence[int]) -> tuple[list[Tensor], Tensor]:
        """Patch tokens (V', P, 2 C) of the chosen views at four depths, camera tokens (V, 2 C) of all."""
        c, chosen = self.network.config, list(views)
        passed = encoded.passed or Passed(c.start, encoded.tokens)
        dense = [passed.kept[i][chosen] for i in c.layers if i in passed.kept]
        one = x = passed.tokens
        for i, one, x in self._passing(encoded, passed, c.depth):
            if i in c.layers:
                dense.append(self._read(one[chosen], x[chosen]))
        return dense, torch.cat([one[:, 0], x[:, 0]], -1)

    def _read(self, one: Tensor, x: Tensor) -> Tensor:
        """Patch tokens (V, P, 2 C) as the heads read them, from all tokens (V, N, C) of two blocks."""
        return torch.cat([one[:, 1:], self.transformer.norm(x[:, 1:])], -1)

    def _passing(self, encoded: Tokens, passed: Passed, depth: int) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Go on to ``depth`` blocks: of each its index, the last tokens of single views, and its own."""
        x = passed.tokens.unsqueeze(0)
        place, same = self.transformer._prepare_rope(1, len(encoded), *encoded.size, x.device)
        one = x
        for i in range(passed.depth, depth):
            if i % 2:
                x = self._block(i, x, "global", same)
            else:
                one = x = self._block(i, x, "local", place)
            yield i, one[0], x[0]

    def _block(self, i: int, x: Tensor, sees: str, place: Tensor) -> Tensor:
        """Tokens (1, V, N, C) after a block that sees one view (``local``) or all (``global``)."""
        vit = self.transformer
        if i in self.recompute and torch.is_grad_enabled():
            return checkpoint(vit.process_attention, x, vit.blocks[i], sees, pos=place, use_reentrant=False)
        return vit.process_attention(x, vit.blocks[i], sees, pos=place)

    def _cameras(self, tokens: Tensor, size: tuple[int, int]) -> Cameras:
        """Cameras of tokens (V, 2 C), by the layers of the package's camera head.

        They give centre, rotation (x, y, z, w) of the camera in the world, and the two fields of view.
        """
        head: Any = self.network.model.cam_dec
        x = head.backbone(tokens)
        pose = rigid(matrix_from_quat(head.fc_qvec(x).roll(1, -1)), head.fc_t(x))
        half = tokens.new_tensor(size) / 2
        focal = half / torch.tan(head.fc_fov(x) / 2).clamp_min(1e-6)
        middle = torch.stack([half[1], half[0], half.new_ones(())]).expand(len(tokens), 3)
        K = torch.diag_embed(torch.cat([focal.flip(-1), focal.new_zeros(len(tokens), 1)], -1))
        return Cameras(pose, torch.cat([K[..., :2], middle.unsqueeze(-1)], -1))


def normalized_cameras(world_from_cam: Tensor) -> Tensor:
    """cam_from_world (V, 4, 4) in the first camera, with centres divided by their median distance from it.

    As ``DepthAnything3`` of the package does it: the median of an even number is the lower of the middle two,
    and the divisor is at least :data:`SMALLEST_SPREAD`.
    """
    cam_from_first = invert(world_from_cam) @ world_from_cam[:1]
    distance = invert(cam_from_first)[:, :3, 3].norm(dim=-1).median().clamp_min(SMALLEST_SPREAD)
    return rigid(cam_from_first[:, :3, :3], cam_from_first[:, :3, 3] / distance)


def _reference(tokens: Tensor) -> int:
    """The package's reference view, from tokens (1, V, N, C) before the last block that is not adapted."""
    from depth_anything_3.model.reference_view_selector import select_reference_view
    from depth_anything_3.utils.constants import THRESH_FOR_REF_SELECTION

    if tokens.shape[1] < THRESH_FOR_REF_SELECTION:
        return 0
    return int(select_reference_view(tokens, strategy="saddle_balanced"))


def published(tensors: Mapping[str, Tensor]) -> DA3Config:
    """Sizes of the published checkpoint that is as wide as these tensors: DA3-SMALL, else DA3-BASE."""
    token = tensors.get("model.backbone.pretrained.cls_token")
    small = DA3Config.small()
    return small if token is not None and token.shape[-1] == small.channels else DA3Config.base()


def load(
    path: Path,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
    recompute: range = range(0),
) -> DA3:
    """Depth Anything 3 with the weights of a file, frozen and in evaluation mode.

    The sizes are those in the file's metadata where it has any (:func:`tco.backbones.checkpoints.save`),
    else those of DA3-BASE or DA3-SMALL.

    Args:
        path: the authors' checkpoint, safetensors or PyTorch's format.
        device: where it runs.
        dtype: of the matrix products; None: what the device multiplies fastest.
        recompute: see :class:`DA3`.

    Raises:
        ModuleNotFoundError: the authors' package is not installed.
        WeightsError: the file is missing, damaged, or of another network.
    """
    place = torch.device(device)
    dtype = dtype or compute_dtype(place)
    network = load_network(path, DA3Network, published, products=(products, dtype))
    return DA3(network, dtype, recompute).eval().requires_grad_(False).to(place)
