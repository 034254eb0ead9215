"""``colmap-tco weights`` against a hub on this machine: licences, broken downloads, foreign files."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch
from safetensors.torch import save

from colmap_tco.errors import InputError, MissingError
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS, PUBLISHED, Checkpoint
from colmap_tco.weights import WeightsConfig, require, table, verify, weights

ROOT = Path(__file__).resolve().parents[2]
VGGT_NAMES = ("aggregator.frame_blocks.0.a", "aggregator.global_blocks.0.a", "depth_head.a")
DA3_NAMES = (
    "model.backbone.pretrained.a",
    "model.head.a",
    "model.cam_enc.a",
    "model.cam_dec.a",
)
PI3_NAMES = ("encoder.a", "decoder.a", "point_decoder.a", "camera_decoder.a")


def file_of(names: tuple[str, ...], size: int = 20_000) -> bytes:
    """A safetensors file with these names and about so many bytes."""
    return save({name: torch.arange(size // len(names) / 4) for name in names})


@dataclass
class Hub:
    """What the server gives and does.

    Attributes:
        content: the one file.
        cut: bytes after which the next download breaks off; 0: none does.
        gated: refuse access.
        ranges: first bytes of the downloads that were asked for.
    """

    content: bytes
    cut: int = 0
    gated: bool = False
    url: str = ""
    ranges: list[int] = field(default_factory=list)


@contextmanager
def serving(hub: Hub) -> Iterator[Hub]:
    """Speak as much of the hub's protocol as a download takes."""

    class Handler(BaseHTTPRequestHandler):
        def respond(self, body: bool) -> None:
            if hub.gated:
                self.send_response(403)
                self.send_header("X-Error-Code", "GatedRepo")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            asked = self.headers.get("Range", "bytes=0-")
            start = int(asked.removeprefix("bytes=").split("-")[0])
            self.send_response(206 if start else 200)
            self.send_header("ETag", f'"{hashlib.sha256(hub.content).hexdigest()}"')
            self.send_header("X-Repo-Commit", CHECKPOINT.revision)
            self.send_header("Content-Length", str(len(hub.content) - start))
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(hub.content) - 1}/{len(hub.content)}")
            self.end_headers()
            if body:
                hub.ranges.append(start)
                end, hub.cut = hub.cut or len(hub.content), 0
                self.wfile.write(hub.content[start:end])
                self.close_connection = True

        def do_HEAD(self) -> None:
            self.respond(body=False)

        def do_GET(self) -> None:
            self.respond(body=True)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    hub.url = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


CHECKPOINT = Checkpoint(
    repository="someone/vggt", revision="a" * 40, file="model.safetensors", size=0, sha256="",
    licence="CC BY-NC 4.0", terms="no commercial use", commercial=False,
    licence_url="https://example.org/licence",
)  # fmt: skip


def published(content: bytes) -> Checkpoint:
    return replace(CHECKPOINT, size=len(content), sha256=hashlib.sha256(content).hexdigest())


FETCH = """
import dataclasses, json, sys
from colmap_tco.errors import MissingError
from colmap_tco.progress import Progress
from colmap_tco.published import NETWORKS, Checkpoint
from colmap_tco.weights import accepted, cached, fetch
checkpoint = Checkpoint(**json.loads(sys.argv[1]))
network = dataclasses.replace(NETWORKS["vggt"], checkpoint=checkpoint)
try:
    path = fetch(network, checkpoint, sys.argv[2] == "accept", Progress())
    assert path == cached(checkpoint) and accepted(network)
    print(path)
except MissingError as error:
    print("MissingError:", error)
"""


def fetched(hub: Hub, home: Path, checkpoint: Checkpoint, accept: bool = True) -> str:
    """What a process of its own says that fetches from this hub into an empty cache."""
    environment = {
        **os.environ, "HF_ENDPOINT": hub.url,
        "HF_HOME": str(home / "hf"), "XDG_CACHE_HOME": str(home / "cache"),
        "HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1",
    }  # fmt: skip
    for name in ("HF_HUB_OFFLINE", "HF_TOKEN", "HF_HUB_CACHE"):
        environment.pop(name, None)
    command = [sys.executable, "-c", FETCH, json.dumps(checkpoint.__dict__), "accept" if accept else ""]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_licence_is_shown_and_must_be_accepted_once(tmp_path: Path) -> None:
    content = file_of(VGGT_NAMES)
    with serving(Hub(content)) as hub:
        refused = fetched(hub, tmp_path, published(content), accept=False)
        assert "licensed CC BY-NC 4.0: no commercial use" in refused
        assert "https://example.org/licence" in refused and "--accept_licence" in refused
        assert not hub.ranges
        path = Path(fetched(hub, tmp_path, published(content)))
        assert path.read_bytes() == content
        assert path.parts[-5:-1] == ("hub", "models--someone--vggt", "snapshots", CHECKPOINT.revision)
        assert fetched(hub, tmp_path, published(content), accept=False) == str(path)
        assert hub.ranges == [0]
        other = replace(published(content), licence="Another")
        assert "licensed Another" in fetched(hub, tmp_path, other, accept=False)


def test_a_download_goes_on_where_it_was_cut_off(tmp_path: Path) -> None:
    """After more than the ten megabytes that the hub's client writes at once."""
    content = file_of(VGGT_NAMES, 25_000_000)
    with serving(Hub(content, cut=15_000_000)) as hub:
        path = ""
        for _ in range(3):  # the hub's client may or may not try again by itself
            path = fetched(hub, tmp_path, published(content))
            if not path.startswith("MissingError"):
                break
            assert "goes on where it stopped" in path
        assert Path(path).read_bytes() == content
        assert hub.ranges[0] == 0 and 0 < hub.ranges[1] <= 15_000_000


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (file_of(PI3_NAMES), "weights of pi3, but --backbone vggt takes model.safetensors of https"),
        (file_of(VGGT_NAMES)[:-4], "was cut off"),
        (file_of(VGGT_NAMES)[:-1] + b"!", "SHA-256 .* not .*damaged or changed"),
    ],
)
def test_what_came_and_is_not_what_was_published_is_refused(
    tmp_path: Path, content: bytes, told: str
) -> None:
    import re

    with serving(Hub(content)) as hub:
        answer = fetched(hub, tmp_path, replace(published(file_of(VGGT_NAMES)), size=len(content)))
    assert answer.startswith("MissingError") and re.search(told, answer), answer


def test_a_gated_repository_says_how_to_get_in(tmp_path: Path) -> None:
    content = file_of(VGGT_NAMES)
    with serving(Hub(content, gated=True)) as hub:
        assert "open on request alone: ask for access there" in fetched(hub, tmp_path, published(content))


@pytest.mark.slow
def test_no_network_says_what_else_can_be_done(tmp_path: Path) -> None:
    content = file_of(VGGT_NAMES)
    with serving(Hub(content)) as hub:
        pass
    answer = fetched(hub, tmp_path, published(content))
    assert "cannot be reached" in answer and "--weights" in answer


def test_a_disk_that_is_too_small_is_found_out_before_the_download(tmp_path: Path) -> None:
    with serving(Hub(b"")) as hub:
        answer = fetched(hub, tmp_path, replace(published(b""), size=10**18))
    assert "1000000000.0 GB are to come" in answer and not hub.ranges


def words(*given: str, home: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "HF_HOME": str(home), "XDG_CACHE_HOME": str(home)}
    environment.pop("HF_HUB_CACHE", None)
    command = [sys.executable, "-m", "colmap_tco", "weights", *given]
    return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


def test_the_list_names_repositories_sizes_and_licences(tmp_path: Path) -> None:
    done = words("list", home=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = {line.split()[0]: line for line in done.stdout.splitlines() if line}
    assert "in the package" in lines["sweep"]
    assert "none yet: python -m benchmarks.gpu.train_mini" in lines["mini"]
    for name, (_, checkpoint) in PUBLISHED.items():
        line = next(line for line in done.stdout.splitlines() if line.startswith(f"{name} "))
        assert checkpoint.repository in line and checkpoint.licence in line
        assert f"colmap-tco weights fetch {name}" in line
        assert f"{name}: {checkpoint.licence}, {checkpoint.terms}" in done.stdout
    assert "5.0 GB" in lines["vggt"] and "3.8 GB" in lines["pi3"]


def test_the_list_tells_which_bytes_are_meant() -> None:
    lines = {line.split()[0]: line for line in table().splitlines() if line}
    for name, (_, c) in PUBLISHED.items():
        assert f"{c.repository}  " in lines[name] and f"  {c.sha256[:12]}…  " in lines[name]


def test_the_list_tells_how_to_install_what_a_network_runs_from(monkeypatch: pytest.MonkeyPatch) -> None:
    da3 = NETWORKS["da3"]
    line = f"da3: pip install 'colmap-tco[da3]' && {da3.install.partition(' && ')[2]}"
    for modules, told in (((), False), (("no_such_module",), True)):
        monkeypatch.setitem(NETWORKS, "da3", replace(da3, modules=modules))
        assert (line in table().splitlines()) == told


@pytest.mark.parametrize(
    ("given", "code", "told"),
    [
        (("path", "vggt"), 5, "not on this machine: fetch them with 'colmap-tco weights fetch vggt' (5.0 GB"),
        (("fetch", "pi3"), 5, "licensed CC BY-NC 4.0: no commercial use"),
        (
            ("fetch",),
            3,
            "name a network; those with weights to fetch are vggt, vggt-commercial, pi3, da3, da3-small",
        ),
        (("fetch", "da3"), 5, "licensed Apache-2.0: commercial use allowed"),
        (("fetch", "vggd"), 3, "there is no network 'vggd'"),
        (("fetch", "sweep"), 3, "in the package"),
        (
            ("fetch", "mini"),
            3,
            "no weights of mini are in the package or published yet: python -m benchmarks",
        ),
        (("steal", "vggt"), 2, "invalid choice: 'steal'"),
        (("verify", "vggt", "--weights", "none.safetensors"), 5, "none.safetensors: no such file"),
    ],
)
def test_mistakes_are_told_with_the_remedy(
    given: tuple[str, ...], code: int, told: str, tmp_path: Path
) -> None:
    done = words(*given, home=tmp_path)
    assert done.returncode == code, done.stderr
    assert told in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_named_file_is_verified(tmp_path: Path) -> None:
    """It is VGGT's by its names, but not the published one."""
    path = tmp_path / "mine.safetensors"
    path.write_bytes(file_of(VGGT_NAMES))
    with pytest.raises(MissingError, match=r"of \d+ bytes, not model\.safetensors of facebook/VGGT-1B"):
        weights("verify", "vggt", WeightsConfig(weights=str(path)), Progress())
    with pytest.raises(InputError, match="there is no network"):
        weights("verify", "none", WeightsConfig(), Progress())
    progress = Progress()
    verify(path, NETWORKS["vggt"], published(path.read_bytes()), progress)
    assert progress.fraction == 1


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(
    ("kind", "names"), [("vggt", VGGT_NAMES), ("pi3", PI3_NAMES), ("da3", DA3_NAMES), ("", ("a",))]
)
def test_a_network_takes_its_own_weights_alone(
    tmp_path: Path, name: str, kind: str, names: tuple[str, ...]
) -> None:
    (tmp_path / "w").write_bytes(file_of(names))
    if NETWORKS[name].kind == kind:
        require(tmp_path / "w", NETWORKS[name])
        return
    with pytest.raises(MissingError, match=rf"w: weights of .*, but --backbone {name} takes"):
        require(tmp_path / "w", NETWORKS[name])


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_facts_are_well_formed(name: str, shared: Path) -> None:
    """The size is that of the tensors that the reference lists, their header, and, for VGGT, a head more."""
    import math

    network, c = PUBLISHED[name]
    assert len(c.revision) == 40 and len(c.sha256) == 64 and int(c.sha256, 16) and int(c.revision, 16)
    assert c.commercial == ("no commercial" not in c.terms)
    if network.kind == "da3":
        return  # tests/tco/test_da3.py computes its size to the byte
    reference = json.loads(
        (shared / "parity" / f"{dict(vggt='vggt_1b', pi3='pi3_large')[network.kind]}.json").read_text()
    )
    least = 4 * sum(math.prod(shape) for shape in reference["state_dict"].values())
    assert least < c.size < least + (3e8 if network.kind == "vggt" else 3e5)
