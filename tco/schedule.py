"""What a step looks at: source views, target views, and when there is nothing more to gain."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor


class Sources:
    """Draws the views that steps render from.

    ``epoch``: a random order, each view once before any comes again. ``overlap``: with odds of the sum
    of what a view has in common with all others. ``uniform``: with equal odds. Within one step no view is
    drawn twice.
    """

    def __init__(self, order: str, overlap: Tensor, generator: torch.Generator, helpers: int = 0) -> None:
        """Draw by ``order`` from V views with ``overlap`` (V, V), the last ``helpers`` of them never.

        Raises:
            ValueError: an order that does not exist.
        """
        if order not in ("epoch", "overlap", "uniform"):
            raise ValueError(f"there is no order of sources {order!r}; choose epoch, overlap or uniform")
        self.order, self.generator, self.queue = order, generator, list[int]()
        odds = overlap.detach().cpu().double().clone()
        odds.fill_diagonal_(0)
        shared = odds.sum(1)[: len(odds) - helpers]
        # Views that share nothing have other terms than the compatibility, and get a chance, too.
        self.odds = shared + 0.01 * shared.mean() if bool(shared.any()) else torch.ones_like(shared)
        if order == "uniform":
            self.odds = torch.ones_like(shared)

    def draw(self, count: int) -> list[int]:
        """The next ``count`` views, or all if there are fewer."""
        count = min(count, len(self.odds))
        if self.order == "epoch":
            drawn: list[int] = []
            while len(drawn) < count:
                drawn.append(self._next(drawn))
            return drawn
        return torch.multinomial(self.odds, count, generator=self.generator).tolist()

    def _next(self, drawn: list[int]) -> int:
        if not self.queue:
            order = torch.randperm(len(self.odds), generator=self.generator).tolist()
            # Taken from the end: what this step has already comes last.
            self.queue = sorted(order, key=lambda view: view not in drawn)
        return self.queue.pop()


def draw_targets(overlap: Tensor, source: int, count: int, generator: torch.Generator) -> list[int]:
    """At most ``count`` views to render ``source`` into, all different; the odds are ``overlap`` (V, V)."""
    odds = overlap[source].detach().cpu().clone()
    odds[source] = 0
    count = min(count, int((odds > 0).sum()))
    return torch.multinomial(odds, count, generator=generator).tolist() if count else []


def most_overlapping(overlap: Tensor, view: int, count: int) -> list[int]:
    """At most ``count`` other views, the best overlapping with ``view`` first; none that shares nothing."""
    shared = overlap[view].detach().cpu().tolist()
    others = [other for other in range(len(shared)) if other != view and shared[other] > 0]
    return sorted(others, key=lambda other: -shared[other])[:count]


class Stagnation:
    """Tells when an error that is measured on one view after another stops falling.

    Views differ in difficulty, so the latest errors of all views are averaged, and the average counts
    once every view was measured.
    """

    def __init__(self, views: Iterable[int], patience: int, gain: float = 0.005) -> None:
        """Stop after ``patience`` measurements of these views without a fall of the average by ``gain``.

        The gain is in the unit of the error; for penalties of residuals in standard deviations, less than
        0.005 is nothing to wait for.
        """
        self.latest = dict.fromkeys(views, math.nan)
        self.patience, self.gain, self.best, self.waited = patience, gain, math.inf, 0

    def add(self, view: int, error: float) -> bool:
        """Record the error of a view; True if it is time to stop."""
        self.latest[view] = error
        average = sum(self.latest.values()) / len(self.latest)
        if math.isnan(average):
            return False
        if average + self.gain < self.best:
            self.best, self.waited = average, 0
        else:
            self.waited += 1
        return self.waited >= self.patience
