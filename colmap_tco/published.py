"""The networks that ``--backbone`` can name: where their weights are, under which licence, how they load.

The facts on checkpoints are those of their publishers: VGGT's README of 29 July 2025 and its model cards
(``facebook/VGGT-1B``: CC BY-NC 4.0; ``facebook/VGGT-1B-Commercial``: VGGT License v1, on request), and the
table of licences in π³'s README. Depth Anything 3: the table in its README, with Apache 2.0 for DA3-BASE
and DA3-SMALL, and CC BY-NC 4.0 for the larger networks for many views; those are left out, as the hub's card
of DA3-LARGE-1.1 is said to contradict that (ByteDance-Seed/Depth-Anything-3, issue 259). Revisions
are pinned, so that size and SHA-256 are those of one file for ever.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any


@dataclass(frozen=True)
class Checkpoint:
    """A published file of weights.

    Attributes:
        repository: on the Hugging Face hub.
        revision: the commit that the other facts are of.
        file: its name in the repository.
        size: in bytes.
        sha256: of its bytes.
        licence: its name.
        terms: what the licence says of commercial use, as a sentence for the user.
        commercial: whether commercial use is allowed.
        licence_url: where its text is.
        gated: whether the publisher gives access on request alone.
    """

    repository: str
    revision: str
    file: str
    size: int
    sha256: str
    licence: str
    terms: str
    commercial: bool
    licence_url: str
    gated: bool = False

    @property
    def page(self) -> str:
        """The repository's page."""
        return f"https://huggingface.co/{self.repository}"


@dataclass(frozen=True)
class Network:
    """A network that can be chosen.

    Attributes:
        name: as ``--backbone`` spells it.
        title: what it is.
        loader: ``module:function``, called with the file of weights, ``device=`` and ``dtype=``, and
            with ``recompute=`` if the network ``recomputes``; gives a :class:`tco.backbones.base.Backbone`.
        kind: whose weights it takes, as :func:`tco.backbones.identify.identify` tells.
        checkpoint: where its weights are published; None if they are in the package, or not made yet.
        training: how weights are made of which there are none yet; empty for all others.
        image_size: longer side of the images that it is given unless the user says otherwise, pixels: as it
            was trained, and a little more for sweep, which gains by it (``docs/quality.md``).
        stride: sides of images are multiples of this.
        tco: settings of :class:`tco.options.TCOConfig` that suit this network, for those which the user
            left at their defaults.
        modules: what it imports that is not among this package's requirements.
        install: the command that brings them.
        most_views: of a chunk. Where all views attend to each other, seconds grow with the square of their
            number; where each looks at its nearest ones, larger chunks predict fewer views twice.
    """

    name: str
    title: str
    loader: str
    kind: str
    checkpoint: Checkpoint | None
    image_size: int
    stride: int
    tco: Mapping[str, Any] = field(default_factory=dict)
    modules: tuple[str, ...] = ()
    install: str = ""
    training: str = ""
    most_views: int = 40

    @property
    def recomputes(self) -> bool:
        """Whether its loader takes ``recompute=``, blocks whose activations are not kept."""
        return self.kind != "sweep"

    def missing(self) -> tuple[str, ...]:
        """Those of ``modules`` that are not installed; nothing is imported."""
        return tuple(module for module in self.modules if find_spec(module) is None)


_PAPER = {"lora_targets": ("qkv", "proj", "fc1", "fc2"), "rate": 5e-4, "steps": 40}
"""Layers with adapters, learning rate and steps of the published code (arXiv 2604.03878)."""

_DA3: dict[str, Any] = {
    "loader": "tco.backbones.da3:load",
    "kind": "da3",
    "image_size": 504,
    "stride": 14,
    "tco": _PAPER,
    "modules": ("depth_anything_3", "addict", "einops", "omegaconf"),
    "install": "pip install 'colmap-tco[da3]' && pip install --no-deps depth-anything-3==0.1.1",
}
_DA3_LICENCE: dict[str, Any] = {
    "licence": "Apache-2.0",
    "terms": "commercial use allowed",
    "commercial": True,
    "licence_url": "https://www.apache.org/licenses/LICENSE-2.0",
}

_VGGT_LICENCE = "https://github.com/facebookresearch/vggt/blob/main/LICENSE.txt"

NETWORKS: dict[str, Network] = {
    network.name: network
    for network in (
        Network(
            name="sweep",
            title="plane sweep with known cameras, in the package",
            loader="tco.backbones.weights:load_sweep",
            kind="sweep",
            checkpoint=None,
            image_size=320,
            stride=16,
            tco={"uncertain_steps": 12},
            most_views=128,
        ),
        Network(
            name="mini",
            title="a small VGGT that finds its cameras, trained in this repository",
            loader="tco.backbones.mini:load",
            kind="mini",
            checkpoint=None,
            image_size=192,
            stride=8,
            tco=_PAPER,
            training="python -m benchmarks.gpu.train_mini, in a checkout, makes some within half an hour on "
            "a large GPU (benchmarks/gpu/README.md)",
        ),
        Network(
            name="vggt",
            title="VGGT-1B (Wang et al. 2025)",
            loader="tco.backbones.vggt:load",
            kind="vggt",
            checkpoint=Checkpoint(
                repository="facebook/VGGT-1B",
                revision="860abec7937da0a4c03c41d3c269c366e82abdf9",
                file="model.safetensors",
                size=5_026_367_224,
                sha256="f164acf60724910d8fe1578bb499d800850c7bb0948db7555c413f9fbe60467e",
                licence="CC BY-NC 4.0",
                terms="no commercial use; for that there is vggt-commercial",
                commercial=False,
                licence_url="https://creativecommons.org/licenses/by-nc/4.0/",
            ),
            image_size=518,
            stride=14,
            tco=_PAPER,
        ),
        Network(
            name="vggt-commercial",
            title="VGGT-1B, trained for commercial use",
            loader="tco.backbones.vggt:load",
            kind="vggt",
            checkpoint=Checkpoint(
                repository="facebook/VGGT-1B-Commercial",
                revision="ebb29a532abe92960eeb6903a5530f16990ef4ab",
                file="model.safetensors",
                size=5_026_367_224,
                sha256="2b766b284359bc47ce26be107254621f685b758a0282082ff109f3ff02788b53",
                licence="VGGT License v1",
                terms="commercial use allowed, military use not; access is given on request",
                commercial=True,
                licence_url=_VGGT_LICENCE,
                gated=True,
            ),
            image_size=518,
            stride=14,
            tco=_PAPER,
        ),
        Network(
            name="pi3",
            title="π³ (Wang et al. 2025)",
            loader="tco.backbones.pi3:load",
            kind="pi3",
            checkpoint=Checkpoint(
                repository="yyfz233/Pi3",
                revision="ae722e7039287d0c8fde9f11f197f804f44b510c",
                file="model.safetensors",
                size=3_834_909_248,
                sha256="33580e4702ac671558aedeab1148fd08118f7ce45bdbeb99f3e3cf340062875d",
                licence="CC BY-NC 4.0",
                terms="no commercial use",
                commercial=False,
                licence_url="https://creativecommons.org/licenses/by-nc/4.0/",
            ),
            image_size=518,
            stride=14,
            tco=_PAPER,
        ),
        Network(
            name="da3",
            title="Depth Anything 3, base (Lin et al. 2025)",
            checkpoint=Checkpoint(
                repository="depth-anything/DA3-BASE",
                revision="f4a6c9b3c95e41c82048423d3493a81ec3fa810e",
                file="model.safetensors",
                size=541_518_028,
                sha256="e01067dc1659613083d9145a9a2547ccdbe6ccbbf83c4fe7b3e8a4e2bdae78b5",
                **_DA3_LICENCE,
            ),
            **_DA3,
        ),
        Network(
            name="da3-small",
            title="Depth Anything 3, small (Lin et al. 2025)",
            checkpoint=Checkpoint(
                repository="depth-anything/DA3-SMALL",
                revision="e08cab65ca0ec38e7826075418411ab90cab4da3",
                file="model.safetensors",
                size=137_248_940,
                sha256="364492e38a3a06d221ac75da7f6621ada3f2361cd24fde11ba79091e9f40efcf",
                **_DA3_LICENCE,
            ),
            **_DA3,
        ),
    )
}

PUBLISHED: dict[str, tuple[Network, Checkpoint]] = {
    name: (network, network.checkpoint) for name, network in NETWORKS.items() if network.checkpoint
}
"""Those whose weights have to be fetched."""
