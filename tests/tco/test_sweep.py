"""The embedded network: its symmetries, the parts of its decoder with known answers, and its quality."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tco.backbones import sweep
from tco.backbones.base import Backbone
from tco.backbones.decoder import SweepConfig, convex_upsample, soft_argmax
from tco.backbones.layers import normalised
from tco.backbones.sweep import Encoded, Sweep, expected_confidence
from tco.backbones.sweeping import interpolate_points, relative_cameras
from tco.backbones.warp import correlate
from tco.backbones.weights import EMBEDDED, load_sweep
from tco.geometry import rigid, so3_exp
from tco.lora import LoRAConfig, adapted
from tco.options import TCOConfig
from tco.types import Cameras, Prediction, Priors, SparseDepth, Views

Rendered = tuple[Views, Priors, Tensor]
TINY = SweepConfig(
    planes=16, groups=(4, 2), coarse=16, fine=8, context=8, volume=6, tokens=32, heads=2, blocks=1, hidden=16
)


@pytest.fixture(autouse=True)
def _no_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


@pytest.fixture(scope="module", autouse=True)
def _full_precision() -> Iterator[None]:
    """Symmetries are tested without the rounding of bfloat16."""
    kept, sweep.compute_dtype = sweep.compute_dtype, lambda _: torch.float32
    yield
    sweep.compute_dtype = kept


def test_reduced_precision_changes_little(
    network: Sweep, encoded: Encoded, full: Prediction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a processor with bfloat16 computes by itself; here it is made to."""
    monkeypatch.setattr(sweep, "compute_dtype", lambda _: torch.bfloat16)
    got = network.decode(encoded)
    assert not torch.equal(got.depth, full.depth)
    assert_mostly_equal(got.depth, full.depth, 0.01, 0.95)


def test_the_type_of_the_products_can_be_chosen(
    rendered: Rendered, full: Prediction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the device is faster in."""
    monkeypatch.setattr(sweep, "compute_dtype", lambda _: torch.bfloat16)
    depths = []
    for dtype in (torch.float32, torch.bfloat16):
        network = load_sweep(dtype=dtype)
        with torch.no_grad():
            depths.append(network.decode(network.encode(*rendered[:2])).depth)
    assert torch.equal(depths[0], full.depth)
    assert not torch.equal(depths[1], full.depth)
    assert_mostly_equal(depths[1], full.depth, 0.01, 0.95)


@pytest.fixture(scope="module")
def network() -> Sweep:
    return load_sweep()


@pytest.fixture(scope="module")
def encoded(network: Sweep, rendered: Rendered) -> Encoded:
    with torch.no_grad():
        return network.encode(*rendered[:2])


@pytest.fixture(scope="module")
def full(network: Sweep, encoded: Encoded) -> Prediction:
    with torch.no_grad():
        return network.decode(encoded)


def assert_mostly_equal(a: Tensor, b: Tensor, tolerance: float = 1e-3, share: float = 0.99) -> None:
    """Equal but for pixels in which rounding decides between two planes that are equally good."""
    assert ((a / b - 1).abs() < tolerance).float().mean() > share


def tiny(seed: int = 0) -> Sweep:
    torch.manual_seed(seed)
    return Sweep(TINY).eval()


def noise_scene(seed: int = 0, views: int = 3, size: tuple[int, int] = (32, 48)) -> tuple[Views, Priors]:
    """Random images of views in a row, with points at random depths."""
    g, (h, w) = torch.Generator().manual_seed(seed), size
    pose = torch.eye(4).repeat(views, 1, 1)
    pose[:, 0, 3] = 0.2 * torch.arange(views)
    K = torch.tensor([[40.0, 0, w / 2], [0, 40.0, h / 2], [0, 0, 1]]).repeat(views, 1, 1)
    sparse = tuple(
        SparseDepth(
            torch.rand(30, 2, generator=g) * torch.tensor([w, h]),
            1 + torch.rand(30, generator=g),
            torch.full((30,), 0.01),
            torch.arange(30),
        )
        for _ in range(views)
    )
    overlap = 30 - 5 * (torch.arange(views)[:, None] - torch.arange(views)).abs().float()
    overlap.fill_diagonal_(0)
    images = torch.rand(views, 3, h, w, generator=g)
    names = tuple(f"{i}.png" for i in range(views))
    return Views(images, torch.ones(views, h, w, dtype=torch.bool), names), Priors(
        Cameras(pose, K), sparse, overlap=overlap
    )


def test_it_is_a_backbone(network: Sweep, rendered: Rendered) -> None:
    assert isinstance(network, Backbone)
    assert network.uses_cameras
    assert rendered[0].size[0] % network.stride == 0
    decoder = {id(p) for p in network.decoder().parameters()}
    assert decoder and decoder < {id(p) for p in network.parameters()}


def test_a_prediction_is_of_the_right_shape_and_passes_the_cameras_through(
    full: Prediction, rendered: Rendered
) -> None:
    views, priors, truth = rendered
    assert full.depth.shape == full.confidence.shape == truth.shape
    assert full.views == tuple(range(len(views)))
    assert priors.cameras is not None
    assert torch.equal(full.cameras.world_from_cam, priors.cameras.world_from_cam)
    assert torch.equal(full.cameras.K, priors.cameras.K)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("images", ["noise", "black", "masked"])
def test_depths_are_positive_and_finite_for_any_weights_and_images(seed: int, images: str) -> None:
    views, priors = noise_scene(seed)
    if images == "black":
        views = replace(views, images=torch.zeros_like(views.images))
    if images == "masked":
        views = replace(views, valid=torch.zeros_like(views.valid))
    network = tiny(seed)
    for parameter in network.parameters():
        parameter.mul_(3)  # far from the small values of a fresh network
    got = network.decode(network.encode(views, priors))
    assert bool(torch.isfinite(got.depth).all()) and bool((got.depth > 0).all())
    assert bool(torch.isfinite(got.confidence).all()) and bool((got.confidence >= 1).all())


@pytest.mark.parametrize("chosen", [[0], [3], [1, 4], [4, 2, 0]])
def test_a_view_is_decoded_alike_alone_and_in_company(
    network: Sweep, encoded: Encoded, full: Prediction, chosen: Sequence[int]
) -> None:
    """With the context of the same weights a view's depth does not depend on which others are asked for."""
    some = network.decode(encoded, chosen, full)
    assert some.views == tuple(chosen)
    assert len(some.cameras) == len(encoded.lo)
    for i, view in enumerate(chosen):
        alone = network.decode(encoded, [view], full)
        assert_mostly_equal(some.depth[i], alone.depth[0], 1e-4, 0.999)
        assert_mostly_equal(some.confidence[i], alone.confidence[0], 1e-3, 0.999)
    assert_mostly_equal(some.depth, full.depth[list(chosen)], 1e-3, 0.999)
    assert torch.equal(network.decode(encoded, context=some).depth, full.depth)


def test_a_context_of_another_network_is_taken_by_its_depths(
    network: Sweep, encoded: Encoded, full: Prediction
) -> None:
    plain = replace(full, stages=())
    assert_mostly_equal(network.decode(encoded, [1], plain).depth[0], full.depth[1], 0.02, 0.9)


def test_the_context_matters(network: Sweep, encoded: Encoded, full: Prediction) -> None:
    """Other views' depths are evidence: with wrong ones the result is another."""
    stages = tuple(torch.stack([s[:, 0] / 0.9, s[:, 1]], 1) for s in full.stages)
    for wrong in (replace(full, stages=stages), replace(full, depth=0.9 * full.depth, stages=())):
        depth = network.decode(encoded, [2], wrong).depth[0]
        assert ((depth / full.depth[2] - 1).abs() > 0.01).float().mean() > 0.1


@pytest.mark.parametrize("scale", [4096.0, 0.25, 37.3])
def test_depth_scales_with_all_lengths(
    network: Sweep, rendered: Rendered, full: Prediction, scale: float
) -> None:
    """Powers of two round alike, so that all pixels agree; for others rounding may choose another plane."""
    views, priors, _ = rendered
    assert priors.cameras is not None and priors.sparse is not None
    pose = priors.cameras.world_from_cam.clone()
    pose[:, :3, 3] *= scale
    scaled = replace(
        priors,
        cameras=Cameras(pose, priors.cameras.K),
        sparse=tuple(replace(points, depth=points.depth * scale) for points in priors.sparse),
    )
    got = network.decode(network.encode(views, scaled))
    if scale == 37.3:
        assert_mostly_equal(got.depth / scale, full.depth)
    else:
        torch.testing.assert_close(got.depth / scale, full.depth, rtol=1e-3, atol=0)


def test_the_world_frame_does_not_matter(network: Sweep, rendered: Rendered, full: Prediction) -> None:
    views, priors, _ = rendered
    assert priors.cameras is not None
    motion = rigid(so3_exp(torch.tensor([0.7, -1.9, 0.4])), torch.tensor([1.0, -2.0, 0.5]))
    moved = replace(priors, cameras=Cameras(motion @ priors.cameras.world_from_cam, priors.cameras.K))
    assert_mostly_equal(network.decode(network.encode(views, moved)).depth, full.depth)


def test_the_order_of_the_views_permutes_the_result(
    network: Sweep, rendered: Rendered, full: Prediction
) -> None:
    views, priors, _ = rendered
    assert priors.cameras is not None and priors.sparse is not None and priors.overlap is not None
    order = torch.tensor([3, 0, 4, 1, 2])
    shuffled = Views(views.images[order], views.valid[order], tuple(views.names[i] for i in order))
    known = Priors(
        priors.cameras[order],
        tuple(priors.sparse[i] for i in order.tolist()),
        overlap=priors.overlap[order][:, order],
    )
    got = network.decode(network.encode(shuffled, known))
    assert_mostly_equal(got.depth, full.depth[order])


def test_brightness_and_contrast_of_a_view_do_not_matter(
    network: Sweep, rendered: Rendered, full: Prediction
) -> None:
    """Images are whitened before all else; not exactly, for the variance has a floor."""
    views, priors, _ = rendered
    gain = torch.tensor([1.0, 0.8, 0.7, 0.9, 0.75]).view(-1, 1, 1, 1)
    bias = torch.tensor([0.0, 0.1, 0.05, 0.0, 0.2]).view(-1, 1, 1, 1)
    changed = replace(views, images=gain * views.images + bias)
    maps = [network.features(v.images, v.valid) for v in (views, changed)]
    flat = [(coarse, fine, *context) for coarse, fine, context in maps]
    for ours, theirs in zip(*flat, strict=True):
        assert (ours - theirs).abs().mean() < 0.02 * ours.std()
    got = network.decode(network.encode(changed, priors))
    assert_mostly_equal(got.depth, full.depth, 0.01, 0.95)


def test_pixels_outside_the_mask_do_not_matter(network: Sweep, rendered: Rendered) -> None:
    views, priors, _ = rendered
    valid = views.valid.clone()
    valid[:, :, 112:] = False
    black = torch.where(valid.unsqueeze(1), views.images, 0.0)
    white = torch.where(valid.unsqueeze(1), views.images, 1.0)
    a, b = (network.decode(network.encode(Views(i, valid, views.names), priors)) for i in (black, white))
    assert torch.equal(a.depth, b.depth)


def test_batches_of_views_do_not_matter(
    network: Sweep, encoded: Encoded, full: Prediction, rendered: Rendered, monkeypatch: pytest.MonkeyPatch
) -> None:
    for cells in (1, 2 * encoded.volume[0, ..., 0].numel(), 10**9):
        monkeypatch.setattr(sweep, "BATCH", cells)
        assert_mostly_equal(network.decode(encoded).depth, full.depth, 1e-3, 0.999)
        torch.testing.assert_close(network.encode(*rendered[:2]).volume, encoded.volume, rtol=0.02, atol=0.02)


def test_volumes_are_alike_whether_gradients_are_recorded_or_not(
    network: Sweep, encoded: Encoded, rendered: Rendered
) -> None:
    """In loops and in place without, by torch's operators and one after the other with them."""
    with torch.enable_grad():
        recorded = network.encode(*rendered[:2]).volume
    off = (recorded - encoded.volume).abs()
    assert float(off.mean()) < 0.01 * float(encoded.volume.abs().mean())


def test_other_points_change_the_views_that_they_are_of(
    network: Sweep, encoded: Encoded, full: Prediction, rendered: Rendered
) -> None:
    _, priors, _ = rendered
    assert priors.sparse is not None
    same = network.with_points(encoded, dict(enumerate(priors.sparse)))
    assert torch.equal(network.decode(same).depth, full.depth)

    few = network.with_points(encoded, {1: priors.sparse[1][torch.arange(4)]})
    for old, new in zip(encoded.hints, few.hints, strict=True):  # of both resolutions
        changed = (old.nearest != new.nearest).flatten(1).any(1)
        assert changed.tolist() == [False, True, False, False, False]
    # Each alone: of views that are decoded together, each gets what is new of the others.
    before, after = ([network.decode(e, [i], full).depth[0] for i in range(3)] for e in (encoded, few))
    assert torch.equal(before[0], after[0]) and torch.equal(before[2], after[2])
    assert ((before[1] / after[1] - 1).abs() > 0.01).float().mean() > 0.05


def test_all_adapters_get_gradients_and_the_network_none(
    network: Sweep, encoded: Encoded, full: Prediction
) -> None:
    before = {k: v.clone() for k, v in network.state_dict().items()}
    with torch.enable_grad():
        assert not network.decode(encoded, [1], full).depth.requires_grad
        with adapted(network.decoder(), LoRAConfig(targets=TCOConfig().lora_targets)) as parameters:
            got = network.decode(encoded, [1], full)
            (got.depth.mean() + got.confidence.log().mean()).backward()
            gradients = [p.grad for p in parameters]
            assert all(g is not None and bool(torch.isfinite(g).all()) for g in gradients)
            # B starts at zero, so that at first only it gets a gradient, and A none.
            assert all(bool(g.any()) for g in gradients[1::2] if g is not None)
            assert all(p.grad is None for p in network.parameters())
            for parameter in parameters:
                parameter.data += 0.3 * torch.randn_like(parameter)
            assert not torch.equal(network.decode(encoded, [1], full).depth, got.depth)
    assert {k: torch.equal(v, before[k]) for k, v in network.state_dict().items()} == dict.fromkeys(
        before, True
    )
    assert torch.equal(network.decode(encoded, [1], full).depth, got.depth)


def test_what_the_sweep_needs_is_asked_for() -> None:
    views, priors = noise_scene()
    for name in ("cameras", "sparse", "overlap"):
        with pytest.raises(ValueError, match="needs cameras, sparse points and overlap"):
            tiny().encode(views, replace(priors, **{name: None}))
    one = Views(views.images[:1], views.valid[:1], views.names[:1])
    with pytest.raises(ValueError, match="at least two views"):
        tiny().encode(one, priors)


def test_sources_are_those_that_share_most_and_never_the_view_itself() -> None:
    views, priors = noise_scene(views=5)
    encoded = tiny().encode(views, priors, max_sources=2)
    assert encoded.sources.shape == (5, 2)
    assert set(encoded.sources[2].tolist()) == {1, 3}
    assert set(encoded.sources[0].tolist()) == {1, 2}
    everything = tiny().encode(views, priors).sources
    assert all(sorted([i, *row]) == list(range(5)) for i, row in enumerate(everything.tolist()))


def test_soft_argmax_of_known_distributions() -> None:
    """Probabilities in, expected index and mass of the neighbourhood of the best out."""
    rows = {
        (0, 0, 0, 0, 1, 0, 0, 0): (4.0, 1.0),
        (0, 0, 0.25, 0.75, 0, 0, 0, 0): (2.75, 1.0),
        (0, 0.6, 0, 0, 0.4, 0, 0, 0): (1.0, 0.6),  # the other mode is too far away to be mixed in
        (0, 0.6, 0, 0.4, 0, 0, 0, 0): (1.8, 1.0),
        (0.5, 0.3, 0.2, 0, 0, 0, 0, 0): (0.7, 1.0),
        (0, 0, 0, 0, 0, 0, 0.1, 0.9): (6.9, 1.0),
    }
    p = torch.tensor(list(rows), dtype=torch.float64).T.reshape(1, 8, 1, len(rows))
    index, mass = soft_argmax(p.clamp_min(1e-30).log() + 3.0)
    expected = torch.tensor(list(rows.values()), dtype=torch.float64)
    torch.testing.assert_close(index[0, 0], expected[:, 0])
    torch.testing.assert_close(mass[0, 0], expected[:, 1])


def test_what_is_in_doubt_is_no_background() -> None:
    """The first two of eight planes are background: they need more than a third of all probability."""
    rows = {
        (0.3, 0, 0, 0, 0.1, 0.2, 0.25, 0.15): (5 + 0.45 / 0.7, 0.7),  # the mode is background
        (0.3, 0.3, 0, 0, 0, 0.4, 0, 0): (0.5, 0.6),
        (0, 0.2, 0.4, 0.4, 0, 0, 0, 0): (2.2, 1.0),  # a surface before it may share its planes
        (0, 0.4, 0.6, 0, 0, 0, 0, 0): (1.6, 1.0),  # and what is between the two has the same depth by either
    }
    p = torch.tensor(list(rows), dtype=torch.float64).T.reshape(1, 8, 1, len(rows))
    background = torch.arange(8).view(1, -1) < 2
    index, mass = soft_argmax(p.clamp_min(1e-30).log() - 2.0, background)
    expected = torch.tensor(list(rows.values()), dtype=torch.float64)
    torch.testing.assert_close(index[0, 0], expected[:, 0])
    torch.testing.assert_close(mass[0, 0], expected[:, 1])


@pytest.mark.parametrize("planes", [1, 2, 4])
def test_a_surface_beyond_the_farthest_points_is_where_its_planes_say(planes: int) -> None:
    """Whatever its depth: no jump where the background's probability passes the third."""
    place = torch.linspace(0, 6.9, 70, dtype=torch.float64)
    below = place.floor().long()
    p = torch.zeros(8, 70, dtype=torch.float64)
    p.scatter_(0, below[None], 1 - (place - below)[None])
    p.scatter_add_(0, below[None] + 1, (place - below)[None])
    background = torch.arange(8).view(1, -1) < planes
    index, mass = soft_argmax(p.clamp_min(1e-30).log().view(1, 8, 1, 70), background)
    torch.testing.assert_close(index[0, 0], place)
    torch.testing.assert_close(mass[0, 0], torch.ones_like(place))


def test_neighbouring_planes_count_together() -> None:
    """A surface between planes against a plane that alone is more probable than each of them."""
    p = torch.tensor([0.3, 0, 0, 0, 0.2, 0.25, 0.25, 0], dtype=torch.float64).view(1, 8, 1, 1)
    index, mass = soft_argmax(p.clamp_min(1e-30).log())
    assert float(index) == pytest.approx((4 * 0.2 + 5 * 0.25 + 6 * 0.25) / 0.7)
    assert float(mass) == pytest.approx(0.7)


def test_soft_argmax_is_differentiable_but_for_the_choice_of_the_best() -> None:
    scores = torch.randn(1, 7, 2, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with torch.enable_grad():
        assert torch.autograd.gradcheck(soft_argmax, scores.requires_grad_(True))


def test_upsampling_picks_and_mixes_the_nine_neighbours() -> None:
    x = torch.rand(2, 1, 3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    padded = torch.nn.functional.pad(x, (1, 1, 1, 1), mode="replicate")[:, 0]
    shifts = torch.stack([padded[:, dy : dy + 3, dx : dx + 4] for dy in range(3) for dx in range(3)], 1)

    even = convex_upsample(x, torch.zeros(2, 36, 3, 4, dtype=torch.float64))
    assert even.shape == (2, 6, 8)
    for dy in (0, 1):
        for dx in (0, 1):
            torch.testing.assert_close(even[:, dy::2, dx::2], shifts.mean(1))

    # Each of the four pixels that replace one takes the neighbour that the mask names for it.
    choice = torch.tensor([[0, 4], [5, 7]])
    mask = torch.full((2, 9, 2, 2, 3, 4), -1e3, dtype=torch.float64)
    for dy in (0, 1):
        for dx in (0, 1):
            mask[:, choice[dy, dx], dy, dx] = 0
    picked = convex_upsample(x, mask.reshape(2, 36, 3, 4))
    for dy in (0, 1):
        for dx in (0, 1):
            torch.testing.assert_close(picked[:, dy::2, dx::2], shifts[:, choice[dy, dx]])

    mixed = convex_upsample(x, torch.randn(2, 36, 3, 4, dtype=torch.float64))
    assert bool((mixed >= x.amin() - 1e-12).all()) and bool((mixed <= x.amax() + 1e-12).all())


def test_confidence_is_a_known_function_of_the_expected_error() -> None:
    """A relative error of 2 % has confidence 2, as its unit says; half the error has 3."""
    log_error = torch.tensor([0.02, 0.01]).log()
    torch.testing.assert_close(expected_confidence(log_error), torch.tensor([2.0, 3.0]))


def test_local_normalisation_shows_faint_texture_and_leaves_flat_regions_dark() -> None:
    """Stripes of 1/255 on a wall beside a strong edge are as visible as those of 10/255, not so in colour."""
    x = torch.arange(64)
    stripes = 0.5 + torch.where(x % 4 < 2, 1.0, -1.0) / 2
    image = torch.full((1, 3, 64, 64), 0.5)
    image[..., :16, :] += 0.4
    image[..., 24:40, :] += 1 / 255 * stripes
    image[..., 44:60, :] += 10 / 255 * stripes
    got = normalised(image, torch.ones(1, 64, 64, dtype=torch.bool))
    assert got.shape == (1, 5, 64, 64)
    faint, strong = (got[0, :, rows, 8:-8].std((1, 2)) for rows in (slice(30, 34), slice(50, 54)))
    assert faint[0] < 0.2 * strong[0]
    assert faint[3] > 0.2 * strong[3]
    assert faint[4] < faint[3]


def test_sources_are_fused_by_a_softmax_over_those_that_see() -> None:
    views, priors = noise_scene(4)
    network = tiny()
    encoded = network.encode(views, priors)
    assert priors.cameras is not None
    coarse = network.features(views.images, views.valid)[0]
    relative = relative_cameras(priors.cameras, [1], encoded.sources[1:2], 4)
    planes = (encoded.lo[1] + encoded.step[1] * torch.arange(16)).view(1, -1, 1, 1)
    values, seen = [], []
    for s, source in enumerate(encoded.sources[1].tolist()):
        corr, mask = correlate(coarse, torch.tensor([[1, source]]), relative[:, s], planes, 4)
        values.append(network.fuse(torch.cat([corr, mask[..., None], corr.mean(-1, keepdim=True)], -1)))
        seen.append(mask[..., None])
    scores = torch.stack([v[..., -1:] for v in values]).masked_fill(torch.stack(seen) == 0, -torch.inf)
    expected = (scores.softmax(0).nan_to_num() * torch.stack([v[..., :-1] for v in values])).sum(0)
    assert 0.05 < torch.stack(seen).mean() < 0.95
    torch.testing.assert_close(encoded.volume[1:2], expected, rtol=0.05, atol=0.02)


def test_the_embedded_weights_are_there_and_small() -> None:
    assert EMBEDDED.stat().st_size <= 20 * 2**20


def shares(depth: Tensor, truth: Tensor) -> tuple[float, float]:
    """Share of the known pixels that are off by more than 2 and 5 %."""
    known = truth > 0
    error = (depth[known] / truth[known] - 1).abs()
    return float((error > 0.02).float().mean()), float((error > 0.05).float().mean())


@pytest.mark.parametrize("scene", ["walk", "generated"])
def test_the_embedded_network_beats_interpolation_of_its_points(
    network: Sweep, rendered: Rendered, scene: str
) -> None:
    """A quarter of interpolation's misses at 5 % are gone, and a tenth of those at 2 %, from the same points.

    A network that did not learn to match could at best interpolate; one with random weights misses
    nineteen pixels out of twenty.
    """
    views, priors, truth = rendered
    if scene == "generated":
        from training.dataset import assemble, triangulated
        from training.scenes import generate

        sample = generate(0, 5, (96, 128))
        tracks = triangulated(sample, np.random.default_rng(0))
        views, priors, truth = assemble(sample, sample.images.astype(np.float32) / 255, tracks)
    assert priors.sparse is not None
    ours = shares(network.decode(network.encode(views, priors)).depth, truth)
    plain = shares(1 / interpolate_points(priors.sparse, views.size, 1, views.images).smooth, truth)
    assert ours[0] < 0.9 * plain[0] and ours[1] < 0.75 * plain[1], (ours, plain)


def test_the_embedded_network_knows_where_it_is_wrong(full: Prediction, rendered: Rendered) -> None:
    """The less confident half of the pixels holds most of the errors above 5 %."""
    truth = rendered[2]
    known = truth > 0
    wrong = (full.depth[known] / truth[known] - 1).abs() > 0.05
    confidence = full.confidence[known]
    unsure = confidence < confidence.median()
    assert wrong[unsure].sum() > 3 * wrong[~unsure].sum()
