"""The page of a finished run: its data equals the files, and a browser shows it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from colmap_tco import _pycolmap
from colmap_tco.backbones import NetworkConfig
from colmap_tco.cli import main
from colmap_tco.dense import dense_views
from colmap_tco.densify import DensifyConfig, densify
from colmap_tco.maps import read_map
from colmap_tco.page.content import Limits, content
from colmap_tco.page.quantise import level_values, normal_values, packed
from colmap_tco.page.write import filled, write_page
from colmap_tco.ply import read_ply, read_vis
from colmap_tco.priors import usable_points
from colmap_tco.progress import Progress
from colmap_tco.tracks import read_tracks
from colmap_tco.views import ViewConfig
from colmap_tco.workspace import DensePaths, dense_paths
from tco.options import PolishConfig, TCOConfig

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from tests.conftest import Room

PAGE = Path(_pycolmap.__file__).parent / "page"
TCO = TCOConfig(steps=2, polish=PolishConfig(polish_looks=1))
ROUNDING = 3e-7
"""Of a ratio near one, less one, in single precision: however small the difference is."""


@pytest.fixture(scope="module")
def paths(room: Room, tmp_path_factory: pytest.TempPathFactory) -> DensePaths:
    """A finished run of two steps, for tests that only read."""
    root = tmp_path_factory.mktemp("page") / "a room"
    shutil.copytree(room.root, root)
    config = DensifyConfig(
        network=NetworkConfig(device="cpu", chunk_size=8),
        tco=TCO,
        views=ViewConfig(max_image_size=128),
    )
    densify(root, config, Progress())
    return dense_paths(root)


@pytest.fixture(scope="module")
def embedded(paths: DensePaths) -> dict[str, Any]:
    """The data of the page that the run has written."""
    text = paths.page.read_text("utf-8")
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def unpacked(text: str, dtype: str, columns: int = 1) -> np.ndarray:
    array = np.frombuffer(base64.b64decode(text), dtype)
    return array if columns == 1 else array.reshape(-1, columns)


def picture(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    return np.asarray(found if found.ndim == 2 else found[..., ::-1])


def test_the_cloud_on_the_page_is_the_cloud_on_disk(paths: DensePaths, embedded: dict[str, Any]) -> None:
    points, normals, colors = read_ply(paths.ply)
    cloud = embedded["cloud"]
    assert cloud["count"] == cloud["all"] == len(points) > 1000
    codes, step = unpacked(cloud["xyz"], "<u2", 3), np.array(cloud["step"])
    assert (np.abs(np.array(cloud["corner"]) + codes * step - points) <= 0.501 * step).all()
    assert (unpacked(cloud["rgb"], "u1", 3) == colors).all()
    assert np.abs(unpacked(cloud["normal"], "i1", 3) / 127 - normals).max() <= 0.5 / 127 + 1e-6
    assert (unpacked(cloud["seen"], "u1") == np.diff(read_vis(paths.vis).start)).all()


def test_the_maps_on_the_page_are_the_maps_on_disk(paths: DensePaths, embedded: dict[str, Any]) -> None:
    views = [view for view in embedded["views"] if "maps" in view]
    assert len(views) == 7
    for view in views:
        maps = view["maps"]
        for kind, path in (
            ("depth", paths.depth_map(view["name"])),
            ("confidence", paths.confidence_map(view["name"])),
            ("error", paths.error_map(view["name"])),
        ):
            exact, coded = read_map(path), maps[kind]
            back = level_values(picture(coded["codes"]), coded["low"], coded["high"])
            assert ((back > 0) == (exact > 0)).all()
            there = exact > 0
            assert there.mean() > 0.2
            bound = (coded["high"] / coded["low"]) ** (1 / 508) - 1
            assert np.abs(np.log(back[there] / exact[there])).max() <= np.log1p(bound) + 1e-6
        normal = read_map(paths.normal_map(view["name"]))
        assert np.abs(normal_values(picture(maps["normal"])) - normal).max() <= 1 / 62 + 1e-6


def test_errors_at_points_are_those_of_the_report(paths: DensePaths, embedded: dict[str, Any]) -> None:
    """Computed again from the files alone, counts and medians are what the run has reported.

    Many points of this room project onto the border of two pixels, where rounding decides which depth is
    theirs: the medians must lie between those of the better and of the worse choice.
    """
    model = _pycolmap.read_model(paths.sparse)
    tracks, rows = read_tracks(model), {row["name"]: row for row in embedded["views"]}
    for view in dense_views(paths, model):
        row, depth = rows[view.name], read_map(paths.depth_map(view.name))
        xy, z, _ = usable_points(tracks, view)
        error = unpacked(row["errors"]["error"], "<f4")
        held = unpacked(row["errors"]["held"], "u1") == 1
        assert held.sum() == row["points_held_out"]
        assert (~held).sum() == row["points"]
        choices = []
        for shift in ((-1e-3, -1e-3), (-1e-3, 1e-3), (1e-3, -1e-3), (1e-3, 1e-3)):
            x, y = np.floor(xy + shift).astype(int).T
            choices.append(depth[y.clip(0, depth.shape[0] - 1), x.clip(0, depth.shape[1] - 1)] / z - 1)
        off = np.abs(np.stack(choices) - error) / (1 + np.abs(error))  # single precision
        assert off.min(0).max() < 1e-6
        size = np.abs(np.stack(choices))
        for chosen, reported in ((held, "error_at_held_out"), (~held, "error_at_points")):
            # torch's median, which the run has used, is the lower of the two in the middle.
            best, worst = (np.sort(e[chosen])[(chosen.sum() - 1) // 2] for e in (size.min(0), size.max(0)))
            assert best - ROUNDING <= row[reported] <= worst + ROUNDING


def test_every_step_has_its_terms_and_the_error_at_held_out_points(embedded: dict[str, Any]) -> None:
    (loss,) = embedded["loss"]
    assert {"loss", "photometric", "sparse", "held_out"} <= loss.keys()
    views = len(embedded["views"])
    assert all(len(values) == TCO.all_steps(views) for values in loss.values())
    assert all(0 < value < 1 for value in loss["held_out"])


def test_cameras_are_those_of_the_model(paths: DensePaths, embedded: dict[str, Any]) -> None:
    model = _pycolmap.read_model(paths.sparse)
    for entry in _pycolmap.registered(model):
        (view,) = [row for row in embedded["views"] if row["name"] == entry.name]
        R, t = entry.cam_from_world[:, :3], entry.cam_from_world[:, 3]
        assert np.allclose(R @ view["centre"] + t, 0, atol=1e-9)
        assert np.allclose(view["axes"], R)


def test_a_large_result_is_thinned_and_made_smaller(paths: DensePaths) -> None:
    report = json.loads(paths.report.read_text("utf-8"))
    small = content(paths, report, Limits(cloud=500, observations=100, map_bytes=60_000, smallest=64))
    assert small["cloud"]["count"] == 500 < small["cloud"]["all"]
    shown = [view["maps"] for view in small["views"] if "maps" in view]
    assert shown
    coded = ("depth", "confidence", "error")
    size = sum(len(m["image"] + m["normal"] + "".join(m[kind]["codes"] for kind in coded)) for m in shown)
    assert size <= 60_000
    assert max(max(m["width"], m["height"]) for m in shown) >= 64
    assert all(view["errors"]["count"] <= 50 for view in small["views"])


def test_a_name_cannot_end_the_data() -> None:
    page = filled({"title": "</script><script>alert(1)</script>"})
    assert page.count("</script>") == filled({"title": ""}).count("</script>")
    assert "alert(1)" in page


def test_the_page_asks_for_nothing(paths: DensePaths) -> None:
    page = paths.page.read_text("utf-8")
    assert "default-src 'none'" in page
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:|//)""", page)
    assert paths.page.stat().st_size < 15e6


def test_the_built_page_is_that_of_its_sources() -> None:
    web = PAGE / "web"
    digest = hashlib.sha256()
    for name in ("build.mjs", "package-lock.json", *sorted(f"src/{p.name}" for p in (web / "src").iterdir())):
        digest.update(f"{name}\n".encode() + (web / name).read_bytes())
    built = re.search(
        r'<meta name="built-from" content="(\w+)">', (PAGE / "built/page.html").read_text("utf-8")
    )
    assert built is not None and built[1] == digest.hexdigest(), (
        "npm ci && node build.mjs in a copy of colmap_tco/page/web makes it anew"
    )


def test_the_command_makes_the_page_anew(paths: DensePaths) -> None:
    before = paths.page.read_bytes()
    paths.page.unlink()
    assert main(["report", str(paths.root.parent), "--no_open"]) == 0
    assert paths.page.read_bytes() == before
    assert main(["report", str(paths.root), "--no_open"]) == 3


CHROMIUM = next((path for name in ("chromium", "chromium-browser") if (path := shutil.which(name))), None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Headless Chromium of the system, drawing in software."""
    if CHROMIUM is None:
        pytest.skip("Debian's chromium is not installed: apt-get install chromium")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install .[dev]")
    options = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    if os.geteuid() == 0:
        options.append("--no-sandbox")
    with api.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=options)
        yield started
        started.close()


@pytest.fixture(scope="module")
def opened(browser: Browser, paths: DensePaths) -> Iterator[tuple[Page, list[str], list[str]]]:
    """The page once it shows a view, what it complained of, and what it asked for."""
    page = browser.new_page(viewport={"width": 1366, "height": 820})
    page.set_default_timeout(60_000)
    faults: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(paths.page.as_uri())
    page.wait_for_selector("#view figure[data-map=depth] canvas")
    wait_for_frames(page, 2)
    yield page, faults, asked
    page.close()


def wait_for_frames(page: Page, more: int) -> None:
    """Wait until the cloud was drawn so many times more; the page forbids the driver's own waiting."""

    def count() -> int:
        return int(page.get_attribute("#scene", "data-frames") or 0)

    first = count()
    for _ in range(600):
        if count() >= first + more:
            return
        page.wait_for_timeout(100)
    pytest.fail(f"the cloud was drawn {count() - first} times in a minute")


def drawn(page: Page, selector: str) -> np.ndarray:
    """What a canvas shows, RGBA (H, W, 4)."""
    uri = page.eval_on_selector(selector, "canvas => canvas.toDataURL('image/png')")
    return np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8), -1))


def test_a_browser_opens_it_without_a_complaint(opened: tuple[Page, list[str], list[str]]) -> None:
    page, faults, asked = opened
    assert not faults
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [page.url]


def test_the_cloud_is_drawn_in_many_colours(opened: tuple[Page, list[str], list[str]]) -> None:
    page = opened[0]
    canvas = drawn(page, "#scene")
    there = canvas[..., 3] > 0
    assert there.mean() > 0.03
    assert len(np.unique(canvas[there], axis=0)) > 100
    page.uncheck("#controls [name=dense]")
    page.uncheck("#controls [name=frusta]")
    page.uncheck("#controls [name=turn]")
    wait_for_frames(page, 2)
    assert not drawn(page, "#scene")[..., 3].any()
    page.check("#controls [name=dense]")
    page.check("#controls [name=frusta]")


def test_a_click_on_a_view_shows_its_maps(
    opened: tuple[Page, list[str], list[str]], paths: DensePaths
) -> None:
    page, faults, _ = opened
    name = "view_4.png"
    page.click(f"#strip [data-name='{name}']")
    page.wait_for_selector(f"#view[data-name='{name}']")
    assert page.inner_text("#view .viewhead strong") == name
    assert page.get_attribute(f"#strip [data-name='{name}']", "aria-selected") == "true"
    depth = read_map(paths.depth_map(name))
    shown = drawn(page, "#view [data-map=depth] canvas")
    assert shown.shape[:2] == depth.shape
    # Dark is far: brightness and depth are ordered oppositely.
    brightness = shown[..., :3].astype(float).mean(2)
    there = depth > 0
    ranks = [np.argsort(np.argsort(values[there])) for values in (brightness, depth)]
    assert np.corrcoef(*ranks)[0, 1] < -0.9
    for kind in ("image", "confidence", "normal", "error"):
        assert len(np.unique(drawn(page, f"#view [data-map={kind}] canvas").reshape(-1, 4), axis=0)) > 50
    assert not faults


def test_dots_show_the_points_and_can_be_hidden(opened: tuple[Page, list[str], list[str]]) -> None:
    page = opened[0]
    dots = "#view [data-map=image] .over canvas:nth-child(2)"
    assert drawn(page, dots)[..., 3].any()
    boxes = page.locator("#view .choices input")
    assert boxes.count() == 2
    for i in range(2):
        boxes.nth(i).uncheck()
    assert not drawn(page, dots)[..., 3].any()


def test_curves_map_and_table_are_there(opened: tuple[Page, list[str], list[str]]) -> None:
    page = opened[0]
    assert page.locator("#curves figure[data-term=loss] path.mean").count() == 1
    assert page.locator("#curves figure[data-term=held_out]").count() == 1
    assert page.locator("#map svg g.view").count() == 7
    assert page.locator("#rows tbody tr").count() == 7
    assert "[object" not in page.inner_text("body")
    page.click("#map svg g.view[data-name='view_2.png'] path", force=True)
    page.wait_for_selector("#view[data-name='view_2.png']")


def test_curves_say_where_the_steps_on_the_depths_begin(opened: tuple[Page, list[str], list[str]]) -> None:
    page = opened[0]
    assert "Steps 1 to 2 adapt the network" in page.inner_text("#curves .parts")
    assert page.locator("#curves figure[data-term=loss] line.turn").count() == 1
    named = page.locator("#curves h3").all_inner_texts()
    # What has no words of its own is shown by its key, which is small.
    assert named and all(name[0].isupper() for name in named)


def test_both_passes_of_the_fusion_are_told(
    opened: tuple[Page, list[str], list[str]], paths: DensePaths
) -> None:
    page, fusion = opened[0], json.loads(paths.report.read_text("utf-8"))["fusion"]
    told = page.inner_text("#settings").replace("\u202f", "")
    for part in (fusion, fusion["gaps"]):
        for figures in (part["pixels"], part["comparisons_failed"]):
            assert all(str(number) in told for number in figures.values())
        assert f"{100 * part['tolerance']['depth']:.2f} %" in told


def test_the_ground_has_the_colour_of_how_many_views_saw_it(
    paths: DensePaths, browser: Browser, tmp_path: Path
) -> None:
    """Left of the middle, as the pictures have it, 3 views; right of it 9: one colour each, and a legend."""
    report = json.loads(paths.report.read_text("utf-8"))
    data = content(paths, report)
    data["report"]["seconds"] |= {"optimisation": 1e-4}
    cloud, axes = data["cloud"], [view["axes"] for view in data["views"] if "axes" in view]
    points = np.array(cloud["corner"]) + unpacked(cloud["xyz"], "<u2", 3) * np.array(cloud["step"])
    across = np.cross(np.sum([a[2] for a in axes], axis=0), data["up"])
    right = points @ across > np.median(points @ across)
    cloud["seen"] = packed(np.where(right, 9, 3).astype(np.uint8))
    file = tmp_path / "page.html"
    file.write_text(filled(data), "utf-8")
    page = browser.new_page()
    page.goto(file.as_uri())
    page.wait_for_selector("#view figure[data-map=depth] canvas")
    assert "3 views" in page.inner_text("#map [data-legend=seen]")
    assert "9 views" in page.inner_text("#map [data-legend=seen]")
    assert "in this run; the depth maps were there" in page.inner_text("#head")
    canvas = drawn(page, "#map canvas")
    columns = np.nonzero(canvas[..., 3])[1]
    few, many = (np.where((canvas[..., :3] == bgr).all(2) & (canvas[..., 3] > 0))[1] for bgr in VIRIDIS_ENDS)
    assert len(few) + len(many) > 0.9 * len(columns)
    assert few.max() <= many.min() + 8  # a square of the ground has one colour
    page.close()


VIRIDIS_ENDS = (84, 1, 68), (37, 231, 253)
"""Blue, green, red."""


def test_an_empty_cloud_has_a_page_that_says_why(paths: DensePaths, browser: Browser, tmp_path: Path) -> None:
    from colmap_tco.outputs import write_cloud
    from colmap_tco.ply import join

    copy = DensePaths(tmp_path / "dense-tco")
    shutil.copytree(paths.root, copy.root)
    write_cloud(copy, join([]))
    report = json.loads(copy.report.read_text("utf-8")) | {"points": 0, "no_points": "nothing was confirmed"}
    write_page(copy, report)
    page, faults = browser.new_page(), []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(copy.page.as_uri())
    page.wait_for_selector("#view figure[data-map=depth] canvas")
    assert "nothing was confirmed" in page.inner_text("#scene-note")
    assert not faults
    page.close()
