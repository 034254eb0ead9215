"""Which network runs: the one that was named, or the best that this machine can run now."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from colmap_tco.errors import MissingError
from colmap_tco.memory import (
    FEWEST_VIEWS,
    Footprint,
    canvas_pixels,
    chunk_limit,
    footprint,
    free_memory,
    recomputed,
)
from colmap_tco.published import NETWORKS, PUBLISHED, Network
from colmap_tco.views import View
from colmap_tco.weights import accepted, cached, gigabytes, located, require
from tco.config import check_range, knob
from tco.options import TCOConfig

if TYPE_CHECKING:
    import torch

    from tco.backbones.base import Backbone

log = logging.getLogger(__name__)

EVERY_BLOCK = range(1000)
"""Of a network whose activations are computed again."""


@dataclass(frozen=True)
class NetworkConfig:
    """The network, and where it runs."""

    backbone: str = knob(
        "auto",
        "network that predicts the depths. auto: vggt, pi3 or da3 where there is a CUDA device and its "
        "weights were fetched (colmap-tco weights), else sweep, which is in the package. mini finds its "
        "cameras as vggt does and has no weights yet but those one trains. All but sweep adapt "
        "qkv, proj, fc1, fc2 at a rate of 5e-4 where lora_targets and rate are left alone. da3 and da3-small "
        "need the package depth-anything-3 and take the cameras as input",
        choices=("auto", *NETWORKS),
    )
    weights: str = knob(
        "",
        "file of weights to use instead of those fetched or in the package; with auto it tells the network",
    )
    device: str = knob(
        "auto", "auto: cuda if there is one, else cpu; or any name that torch knows, such as cuda:1"
    )
    chunk_size: int = knob(
        0,
        "views that are optimised together; 0: as many as fit 70 % of the free memory, at most 128 with "
        "sweep and 40 with the others",
    )
    recompute: str = knob(
        "auto",
        "compute what the backward pass needs of the network's blocks again there, instead of keeping it: a "
        "tenth of the memory for each view of vggt, a sixth of pi3, for a third more time. auto: where fewer "
        "views would fit a chunk otherwise. sweep has no such blocks",
        choices=("auto", "always", "never"),
    )

    precision: str = knob(
        "auto",
        "type of the network's products and convolutions. auto: bfloat16 where the device is faster in it, "
        "else float32; all else is float32 in any case",
        choices=("auto", "float32", "bfloat16"),
    )

    def __post_init__(self) -> None:
        check_range(self, "chunk_size", 0)

    @property
    def dtype(self) -> str | None:
        """Name of the type of the products; None: what the device is faster in."""
        return None if self.precision == "auto" else self.precision


class Selected(NamedTuple):
    """A network to run.

    Attributes:
        network: the entry of the registry.
        weights: its file.
        device: where it runs.
        reason: why this one, as a sentence for the user.
        recompute: whether activations are computed again in the backward pass.
        dtype: name of the type of the products; None: what the device is faster in.
    """

    network: Network
    weights: Path
    device: torch.device
    reason: str
    recompute: bool = False
    dtype: str | None = None

    def describe(self) -> dict[str, object]:
        """For the report."""
        c = self.network.checkpoint
        return {
            "name": self.network.name,
            "reason": self.reason,
            "weights": self.weights,
            "licence": None if c is None else f"{c.licence}: {c.terms}",
        }


@dataclass(frozen=True)
class Budget:
    """How many views a chunk may have.

    Attributes:
        needs: memory of the network, as it will be used.
        pixels: of the canvas.
        device: whose memory counts.
        given: what the user asked for; 0: nothing.
        most: views of a chunk of this network.
        recompute: whether activations are computed again in the backward pass.
    """

    needs: Footprint
    pixels: int
    device: torch.device
    given: int
    most: int
    recompute: bool = False

    @classmethod
    def of(cls, chosen: Selected, views: Sequence[View], config: NetworkConfig, steps: int) -> Budget:
        """For these views, and so many steps of optimisation."""
        pixels, most = canvas_pixels(views), chosen.network.most_views
        place = (chosen.network, chosen.device, steps)
        needs, again = needed(place, (len(views), pixels), config)
        return cls(needs, pixels, chosen.device, config.chunk_size, most, again)

    def views(self) -> int:
        """Views a chunk to plan with."""
        if self.given:
            return max(FEWEST_VIEWS, self.given)
        return chunk_limit(self.needs, self.pixels, free_memory(self.device), self.most)

    def views_now(self) -> int:
        """Views that fit at this moment, without the reserve of planning; what was asked for, if so."""
        if self.given:
            return max(FEWEST_VIEWS, self.given)
        return max(FEWEST_VIEWS, int(self.needs.views(self.pixels, free_memory(self.device))))


def needed(
    place: tuple[Network, torch.device, int], size: tuple[int, int], config: NetworkConfig
) -> tuple[Footprint, bool]:
    """Memory of a network, on a device with so many steps, and whether it computes activations again.

    Args:
        place: network, device, steps of optimisation.
        size: how many views there are in all, and the pixels of their canvas.
        config: what the user asked for.
    """
    (network, device, steps), (views, pixels) = place, size
    wanted = config.chunk_size or min(views, network.most_views)
    room = (wanted, pixels, free_memory(device))
    again = recomputed(network.name, device.type, steps, room, config.recompute, config.dtype)
    return footprint(network.name, device.type, steps, config.dtype, again), again


def choose_device(name: str) -> torch.device:
    """The device that ``--device`` names.

    Raises:
        MissingError: it is not there.
    """
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise MissingError(f"--device {name}: not usable here ({error}); try --device cpu") from error
    return device


def select(config: NetworkConfig) -> Selected:
    """The network that a configuration means, with its weights found and looked at, but not read.

    Raises:
        MissingError: no such device, a package that the network needs is not installed, or weights that are
            missing, damaged or of another network.
    """
    device = choose_device(config.device)
    file = Path(config.weights).expanduser() if config.weights else None
    if config.backbone != "auto":
        network = NETWORKS[config.backbone]
        path, reason = file or located(network), f"--backbone {network.name}"
    elif file is not None:
        network, path = _owner(file), file
        reason = f"{file} holds weights of {network.kind}"
    else:
        network, reason = _best(device)
        path = located(network)
    require(path, network)
    if network.missing():
        raise MissingError(
            f"--backbone {network.name} runs from packages that are not installed "
            f"({', '.join(network.missing())}): {network.install}"
        )
    return Selected(network, path, device, reason, config.recompute == "always", config.dtype)


def _owner(path: Path) -> Network:
    """The network that a file of weights is of.

    Raises:
        MissingError: it is of none that is known.
    """
    from tco.backbones.identify import identify
    from tco.backbones.weights import WeightsError

    try:
        found = identify(path)
    except WeightsError as error:
        raise MissingError(str(error)) from error
    for network in NETWORKS.values():
        if network.kind == found.network:
            return network
    raise MissingError(f"{path}: {found}; the networks are {', '.join(NETWORKS)}")


def _best(device: torch.device) -> tuple[Network, str]:
    """The network for ``auto``: a published one if weights, licence, device and memory allow, else sweep."""
    fetched = [name for name in PUBLISHED if cached(PUBLISHED[name][1]) and accepted(NETWORKS[name])]
    ready = [name for name in fetched if not NETWORKS[name].missing()]
    sweep = NETWORKS["sweep"]
    if not ready:
        return sweep, _why_none()
    if device.type != "cuda":
        return sweep, (
            f"auto: {' and '.join(ready)} could run, but take long without a CUDA device; "
            f"--backbone {ready[0]} runs it all the same"
        )
    free = free_memory(device)
    for name in ready:
        network = NETWORKS[name]
        least = footprint(name, device.type, steps=1, recompute=True)
        if least.bytes(FEWEST_VIEWS, network.image_size**2) < free:
            return network, f"auto: fetched, and {gigabytes(free)} of {device} are enough for it"
    return sweep, f"auto: {gigabytes(free)} free on {device} are too little for {' or '.join(ready)}"


def _why_none() -> str:
    """Why no published network is ready to run."""
    there = [NETWORKS[name] for name, (_, checkpoint) in PUBLISHED.items() if cached(checkpoint)]
    why = [f"the licence of {n.name}'s weights was not accepted" for n in there if not accepted(n)]
    why += [f"{n.name} needs {', '.join(n.missing())}, not installed" for n in there if n.missing()]
    if why:
        return f"auto: {'; '.join(why)}; colmap-tco weights list says more"
    return "auto: no weights of a larger network were fetched; colmap-tco weights list shows them"


def load(selected: Selected) -> Backbone:
    """The network on its device, frozen and in evaluation mode.

    Raises:
        MissingError: its file is not whole, or not what it says.
    """
    import torch

    from tco.backbones.weights import WeightsError

    network = selected.network
    dtype: torch.dtype | None = getattr(torch, selected.dtype) if selected.dtype else None
    module, _, name = network.loader.partition(":")
    loader: Callable[..., Backbone] = getattr(import_module(module), name)
    try:
        again = {"recompute": EVERY_BLOCK} if selected.recompute and network.recomputes else {}
        backbone = loader(selected.weights, device=selected.device, dtype=dtype, **again)
    except WeightsError as error:
        raise MissingError(str(error)) from error
    log.info("network %s (%s); %s", network.name, network.title, selected.reason)
    if again:
        log.info("its activations are computed again in each backward pass, to fit more views a chunk")
    if network.checkpoint is not None:
        c = network.checkpoint
        log.info("its weights are %s", selected.weights)
        log.info("its weights are licensed %s: %s; %s", c.licence, c.terms, c.licence_url)
    return backbone


def suited(config: TCOConfig, network: Network, given: Sequence[str] = ()) -> TCOConfig:
    """The settings of optimisation, with the network's own where the user left the defaults.

    Settings named in ``given`` stay in any case: the user asked for what happens to be the default. Who says
    how many steps there shall be gets no more.
    """
    default = TCOConfig()
    untouched = {f.name for f in fields(TCOConfig) if getattr(config, f.name) == getattr(default, f.name)}
    free = untouched.difference(given)
    if "steps" not in free:
        free.discard("uncertain_steps")
    return replace(config, **{name: value for name, value in network.tco.items() if name in free})
