"""``colmap-tco weights``: list, fetch, find and verify the weights of published networks.

Files live in the Hugging Face hub's own cache (``HF_HOME``, ``HF_HUB_CACHE``), so that other programs share
them; beside it this package keeps only a note of the licences that were accepted.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from colmap_tco.atomic import write_text
from colmap_tco.errors import InputError, MissingError
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS, PUBLISHED, Checkpoint, Network
from tco.config import knob

log = logging.getLogger(__name__)

ACTIONS = ("list", "fetch", "path", "verify")
HUB = 'pip install "huggingface_hub>=0.24"'


@dataclass(frozen=True)
class WeightsConfig:
    """Weights of published networks."""

    accept_licence: bool = knob(
        False, "say that you have read the licence of the weights and keep to it; fetch asks for this"
    )
    weights: str = knob("", "file to verify instead of the one in the cache")


@dataclass(frozen=True)
class Told:
    """A text for the user."""

    text: str

    def summary(self) -> str:
        """The text."""
        return self.text


def weights(action: str, name: str | None, config: WeightsConfig, progress: Progress) -> Told:
    """List all networks, or fetch, locate or verify the weights of one.

    Raises:
        InputError: no network of that name, or none named.
        MissingError: the weights are not there or not whole, cannot be fetched, or their licence was not
            accepted.
    """
    if action == "list":
        return Told(table())
    network, checkpoint = _published(name)
    if action == "fetch":
        return Told(str(fetch(network, checkpoint, config.accept_licence, progress)))
    path = Path(config.weights).expanduser() if config.weights else located(network)
    if action == "verify":
        verify(path, network, checkpoint, progress)
        c = checkpoint
        return Told(f"{path}: whole, and as published ({c.repository}, {c.licence}, SHA-256 {c.sha256})")
    return Told(str(path))


def _published(name: str | None) -> tuple[Network, Checkpoint]:
    if name in PUBLISHED:
        return PUBLISHED[name]
    if name in NETWORKS and NETWORKS[name].training:
        raise InputError(none_yet(NETWORKS[name]))
    if name in NETWORKS:
        raise InputError(f"the weights of {name} are in the package: there is nothing to fetch or to verify")
    asked = f"there is no network {name!r}" if name else "name a network"
    raise InputError(f"{asked}; those with weights to fetch are {', '.join(PUBLISHED)}")


def table() -> str:
    """All networks, with repository, size, licence, beginning of the SHA-256, and where their weights are."""
    rows = [("network", "size", "licence", "repository", "SHA-256", "weights")]
    for network in NETWORKS.values():
        c = network.checkpoint
        if c is None:
            state = f"none yet: {network.training}" if network.training else "in the package"
            rows.append((network.name, "", "Apache-2.0", "", "", state))
            continue
        path = cached(c)
        state = str(path) if path else f"not fetched: colmap-tco weights fetch {network.name}"
        rows.append((network.name, gigabytes(c.size), c.licence, c.repository, c.sha256[:12] + "…", state))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    terms = [f"{name}: {c.licence}, {c.terms}; {c.licence_url}" for name, (_, c) in PUBLISHED.items()]
    beside = [f"{n.name}: {n.install}" for n in NETWORKS.values() if n.missing()]
    return "\n".join([*lines, "", *terms, *beside])


def gigabytes(size: float) -> str:
    """A number of bytes to read."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def cached(checkpoint: Checkpoint) -> Path | None:
    """The file in the hub's cache, or None if it, or the hub's package, is not there."""
    try:
        from huggingface_hub import constants
    except ImportError:
        return None
    # The function below takes a fifth of a second to import, for files that most users do not have.
    if not (Path(constants.HF_HUB_CACHE) / f"models--{checkpoint.repository.replace('/', '--')}").is_dir():
        return None
    from huggingface_hub import try_to_load_from_cache

    for revision in (checkpoint.revision, "main"):
        found = try_to_load_from_cache(checkpoint.repository, checkpoint.file, revision=revision)
        if isinstance(found, str) and Path(found).stat().st_size == checkpoint.size:
            return Path(found)
    return None


def none_yet(network: Network) -> str:
    """That a network has no weights to fetch and none in the package, and how to make some."""
    return (
        f"no weights of {network.name} are in the package or published yet: {network.training}; then name "
        "the file with --weights"
    )


def located(network: Network) -> Path:
    """The file of weights of a network on this machine.

    Raises:
        MissingError: it was not fetched, or nobody made it yet; the message says how to.
    """
    checkpoint = network.checkpoint
    if network.training:
        raise MissingError(none_yet(network))
    if checkpoint is None:
        from tco.backbones.weights import EMBEDDED

        return EMBEDDED
    path = cached(checkpoint)
    if path is None:
        raise MissingError(
            f"the weights of {network.name} are not on this machine: fetch them with 'colmap-tco weights "
            f"fetch {network.name}' ({gigabytes(checkpoint.size)} from {checkpoint.page}), or name a file "
            "with --weights"
        )
    return path


def fetch(network: Network, checkpoint: Checkpoint, accept: bool, progress: Progress) -> Path:
    """Download the weights into the hub's cache; a download that was cut off goes on where it stopped.

    Raises:
        MissingError: the licence is not accepted, the hub's package or the network is not there, the disk
            is too small, or what came is not what was published.
    """
    c = checkpoint
    if not accept and not accepted(network):
        raise MissingError(
            f"the weights of {network.name} ({gigabytes(c.size)} from {c.page}) are licensed {c.licence}: "
            f"{c.terms}. Read {c.licence_url} and give --accept_licence if you agree"
        )
    if accept:
        _note_accepted(network, c)
    path = cached(c)
    if path is None:
        path = _download(c)
    verify(path, network, c, progress)
    log.info("%s: %s, licensed %s: %s", path, network.title, c.licence, c.terms)
    return path


def _download(checkpoint: Checkpoint) -> Path:
    """Fetch by the hub's own client."""
    try:
        from huggingface_hub import constants, hf_hub_download
        from huggingface_hub.errors import (
            EntryNotFoundError,
            GatedRepoError,
            HfHubHTTPError,
            LocalEntryNotFoundError,
            RepositoryNotFoundError,
        )
    except ImportError as error:
        raise MissingError(f"fetching takes the package huggingface_hub: {HUB}") from error
    c = checkpoint
    _require_space(Path(constants.HF_HUB_CACHE), c)
    offline = "on a machine without it, copy the file there and name it with --weights"
    try:
        return Path(hf_hub_download(c.repository, c.file, revision=c.revision))
    except GatedRepoError as error:
        raise MissingError(
            f"{c.page} is open on request alone: ask for access there, then log in with 'hf auth login'"
        ) from error
    except LocalEntryNotFoundError as error:
        raise MissingError(f"{c.page} cannot be reached; check the network, or, {offline}") from error
    except (RepositoryNotFoundError, EntryNotFoundError) as error:
        raise MissingError(f"{c.page} has no {c.file} at revision {c.revision} any more: {error}") from error
    except (HfHubHTTPError, OSError, RuntimeError) as error:
        raise MissingError(
            f"fetching {c.file} of {c.page} failed ({error}); the same command goes on where it stopped; "
            f"{offline}"
        ) from error


def _require_space(folder: Path, checkpoint: Checkpoint) -> None:
    """See that the file fits on the disk of the cache, which may not exist yet."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    partly = sum(
        path.stat().st_size
        for path in folder.glob(f"models--{checkpoint.repository.replace('/', '--')}/blobs/*.incomplete")
    )
    free, missing = shutil.disk_usage(there).free, checkpoint.size - partly
    if free < missing:
        raise MissingError(
            f"{folder} has {gigabytes(free)} free, and {gigabytes(missing)} are to come; free some, or set "
            "HF_HOME to a larger disk"
        )


def verify(path: Path, network: Network, checkpoint: Checkpoint, progress: Progress) -> None:
    """See that a file is, to the byte, the published one.

    Raises:
        MissingError: it is not; the message says what it is.
    """
    require(path, network)
    size = path.stat().st_size
    expected = f"{checkpoint.file} of {checkpoint.repository} ({checkpoint.size} bytes)"
    if size != checkpoint.size:
        raise MissingError(f"{path}: weights of this network, but of {size} bytes, not {expected}")
    progress.stage("verify", size)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 24):
            digest.update(block)
            progress.advance(len(block))
    if digest.hexdigest() != checkpoint.sha256:
        raise MissingError(
            f"{path}: SHA-256 {digest.hexdigest()}, not {checkpoint.sha256} of {expected}: the file was "
            "damaged or changed; delete it and fetch it again"
        )


def require(path: Path, network: Network) -> None:
    """See that a file holds weights for a network, by what it says of itself.

    Raises:
        MissingError: it does not; the message says what it is and what was expected.
    """
    from tco.backbones.identify import identify
    from tco.backbones.weights import WeightsError

    try:
        found = identify(path)
    except WeightsError as error:
        raise MissingError(str(error)) from error
    if found.network != network.kind:
        raise MissingError(f"{path}: {found}, but {_expected(network)}")


def _expected(network: Network) -> str:
    c = network.checkpoint
    if network.training:
        return f"--backbone {network.name} takes what this makes: {network.training}"
    if c is None:
        return "--backbone sweep takes those of the embedded network"
    return f"--backbone {network.name} takes {c.file} of {c.page}, {gigabytes(c.size)}"


def accepted(network: Network) -> bool:
    """Whether the licence of these weights was accepted on this machine, in its present wording."""
    note = _notes().get(network.name, {})
    return network.checkpoint is None or note.get("licence") == network.checkpoint.licence


def notes_file() -> Path:
    """Where accepted licences are noted: ``$XDG_CACHE_HOME/colmap-tco/licences.json``."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "colmap-tco" / "licences.json"


def _notes() -> dict[str, Any]:
    try:
        found = json.loads(notes_file().read_text("utf-8"))
    except (OSError, json.JSONDecodeError, UnicodeDecodeError):
        return {}
    return found if isinstance(found, dict) else {}


def _note_accepted(network: Network, checkpoint: Checkpoint) -> None:
    if accepted(network):
        return
    when = datetime.now(timezone.utc).isoformat(timespec="seconds")
    notes = {**_notes(), network.name: {"licence": checkpoint.licence, "accepted": when}}
    write_text(notes_file(), json.dumps(notes, indent=1) + "\n")
