"""``colmap-tco check``: what this machine has, what each network would need, and which one would run."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_tco._pycolmap import Camera, registered
from colmap_tco.backbones import NetworkConfig, Selected, choose_device, needed, select
from colmap_tco.errors import InputError, MissingError
from colmap_tco.image_files import decoded_size, list_images
from colmap_tco.lens import implausible
from colmap_tco.memory import FEWEST_VIEWS, SHARE, chunk_limit, free_memory
from colmap_tco.pinhole import Pinhole, undistorted_camera
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS, Network
from colmap_tco.views import ViewConfig, network_size
from colmap_tco.weights import accepted, cached, gigabytes
from colmap_tco.workspace import WorkspaceConfig, choose_model, existing_root, find_images, find_models
from tco.options import TCOConfig

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class CheckConfig:
    """What densify would be told."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    tco: TCOConfig = field(default_factory=TCOConfig)
    views: ViewConfig = field(default_factory=ViewConfig)
    workspace: WorkspaceConfig = field(default_factory=WorkspaceConfig)


@dataclass(frozen=True)
class Need:
    """What a network would need for a workspace.

    Attributes:
        network: which.
        size: (width, height) of the canvas.
        chunk: views of a chunk.
        bytes: peak memory with such chunks.
        measured: whether the footprint was measured on such a device.
        state: whether it can run now, and what it lacks.
        recompute: whether activations would be computed again in the backward pass.
    """

    network: Network
    size: tuple[int, int]
    chunk: int
    bytes: int
    measured: bool
    state: str
    recompute: bool


@dataclass(frozen=True)
class Checked:
    """What was found.

    Attributes:
        machine: sentences on devices and memory.
        images: a sentence on the workspace.
        needs: one a network.
        choice: which would run, and why; or why none would.
    """

    machine: tuple[str, ...]
    images: str
    needs: tuple[Need, ...]
    choice: str

    def summary(self) -> str:
        """All of it, as a table."""
        rows = [("network", "images", "views a chunk", "memory", "state")]
        rows += [
            (
                need.network.name,
                f"{need.size[0]}×{need.size[1]}",
                str(need.chunk),
                ("" if need.measured else "about ") + gigabytes(need.bytes),
                need.state,
            )
            for need in self.needs
        ]
        widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
        table = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([*self.machine, self.images, "", *table, "", self.choice])


def check(root: Path, config: CheckConfig, progress: Progress) -> Checked:
    """Look at the machine and the workspace; nothing is written and no network is loaded.

    Raises:
        InputError: the workspace has no pictures, or one alone and no model.
        MissingError: no such device.
    """
    progress.stage("check", 1)
    device = choose_device(config.network.device)
    cameras, told = _cameras(existing_root(root), config.workspace)
    needs = tuple(_need(network, device, cameras, config) for network in NETWORKS.values())
    return Checked(machine(device), told, needs, _choice(config, needs))


def machine(device: torch.device) -> tuple[str, ...]:
    """Sentences on processor, memory and devices."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    lines = [f"{cores} cores, {gigabytes(free_memory())} of memory to be had; PyTorch {torch.__version__}"]
    for index in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(index)
        free = gigabytes(free_memory(torch.device("cuda", index)))
        lines.append(
            f"cuda:{index}: {properties.name}, {free} of {gigabytes(properties.total_memory)} to be had"
        )
    if not torch.cuda.is_available():
        lines.append("no CUDA device")
    lines.append(f"densify would run on {device}")
    return tuple(lines)


def _cameras(root: Path, config: WorkspaceConfig) -> tuple[list[Pinhole], str]:
    """The undistorted cameras of the images that would be used, and a sentence on them."""
    folders = [Path(config.model_path)] if config.model_path else find_models(root)
    if folders:
        chosen = choose_model(root, folders)
        entries = registered(chosen.model)
        found = [pinhole for entry in entries for pinhole in _pinhole(entry.camera)]
        told = [f"{len(found)} images registered in {chosen.folder}", *implausible(entries)]
        return found, "\n".join(told)
    folder, found = find_images(root, config.image_path), []
    for name in list_images(folder, recursive=folder != root):
        try:
            width, height = decoded_size(folder / name)
        except InputError:  # densify says which, and why
            continue
        found.append(Pinhole(width, height, width, width, width / 2, height / 2))
    if not found:
        raise InputError(f"{folder}: no picture in it can be decoded")
    if len(found) < 2:
        raise InputError(f"{folder}: one picture; densify needs at least two, and three or more to map them")
    return found, f"{len(found)} images in {folder}, which densify would map first"


def _pinhole(camera: Camera) -> list[Pinhole]:
    """The undistorted camera, or none if densify would leave its images out."""
    try:
        return [undistorted_camera(camera)]
    except InputError:
        return []


def _need(network: Network, device: torch.device, cameras: Sequence[Pinhole], config: CheckConfig) -> Need:
    """What one network would need with these images on a common canvas."""
    longest = config.views.max_image_size or network.image_size
    canvases = [network_size(camera, longest, network.stride) for camera in cameras]
    canvas = max(w for w, _ in canvases), max(h for _, h in canvases)
    pixels, free = canvas[0] * canvas[1], free_memory(device)
    given, place = config.network.chunk_size, (network, device, config.tco.steps)
    needs, again = needed(place, (len(cameras), pixels), config.network)
    limit = max(FEWEST_VIEWS, given) if given else chunk_limit(needs, pixels, free, network.most_views)
    chunk = min(limit, len(cameras))
    state = _state(network, config.network.weights, needs.bytes(FEWEST_VIEWS, pixels), free)
    return Need(network, canvas, chunk, needs.bytes(chunk, pixels), bool(needs.measured), state, again)


def _state(network: Network, file: str, least: int, free: int) -> str:
    """Whether a network could run now, with a file that the user named or those on this machine."""
    if network.missing():
        return f"needs {', '.join(network.missing())}, not installed: {network.install}"
    c = network.checkpoint
    if file and _kind(Path(file).expanduser()) != network.kind:
        return "the file named with --weights is not of it"
    if not file and network.training:
        return f"no weights yet: {network.training}"
    if not file and c is not None and cached(c) is None:
        return f"not fetched ({gigabytes(c.size)}, {c.licence}): colmap-tco weights fetch {network.name}"
    if least > free:
        return f"does not fit: {gigabytes(least)} for {FEWEST_VIEWS} views, {gigabytes(free)} to be had"
    if not file and not accepted(network):
        return (
            f"ready with --backbone {network.name}; auto leaves it out until its licence is accepted: "
            f"colmap-tco weights fetch {network.name} --accept_licence"
        )
    return "ready"


def _kind(file: Path) -> str:
    """The kind of network that a file of weights is of; empty if it is of none, or not whole."""
    from tco.backbones.identify import identify
    from tco.backbones.weights import WeightsError

    try:
        return identify(file).network
    except WeightsError:
        return ""


def _choice(config: CheckConfig, needs: Sequence[Need]) -> str:
    """What densify would do with these settings."""
    try:
        chosen: Selected = select(config.network)
    except MissingError as error:
        return f"densify would stop: {error}"
    by_name: Mapping[str, Any] = {need.network.name: need for need in needs}
    need = by_name[chosen.network.name]
    return (
        f"densify would run {chosen.network.name} ({chosen.reason}) in chunks of up to {need.chunk} views"
        f"{', their activations computed again in each backward pass' if need.recompute else ''}, "
        f"which take {gigabytes(need.bytes)}; planned for {SHARE:.0%} of what is free now"
    )
