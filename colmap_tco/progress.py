"""How far a run is: one bar with an estimate on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

logger = logging.getLogger(__name__)

_BAR = "{desc} {percentage:3.0f}%|{bar}| {elapsed}{postfix}"
_TOO_EARLY = 0.2
"""Share of a run below which its time so far, with imports and compilation, says nothing of the rest."""

_TOO_LITTLE = 0.02
"""Share of a stage below which its pace says nothing of the rest."""


class Progress:
    """Progress of a whole run, which is a sequence of stages.

    A run first states what share of its time each stage takes (:meth:`plan`); the estimate follows from the
    pace of the current stage, its first step apart, and from the shares of those to come. A loop over
    chunks is one stage whose total counts all chunks. Without a plan, it is that of the current stage alone.

    With ``bar`` it draws on stderr; without, it logs a line at INFO when a stage begins, and then
    one at most every ``interval`` seconds, with the figures in the record's ``data``.
    """

    def __init__(self, bar: bool = False, interval: float = 10.0) -> None:
        self.interval = interval
        self._shares: dict[str, float] = {}
        self._finished = 0.0
        self._names: list[str] = []
        self._total = 0
        self._done = 0.0
        self._values: dict[str, float] = {}
        self._run_start = self._stage_start = self._last_line = time.monotonic()
        self._first = (self._stage_start, 0.0)
        self._bar = _open_bar() if bar else None

    def plan(self, shares: Mapping[str, float]) -> None:
        """State the stages to come and how long each takes relative to the others.

        Raises:
            ValueError: a share is negative, or none is positive.
        """
        total = sum(shares.values())
        if total <= 0 or min(shares.values()) < 0:
            raise ValueError(f"the shares of a plan must be positive: {dict(shares)}")
        self._shares = {name: share / total for name, share in shares.items()}

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of ``total`` steps; the stage before it is finished, its total reached or not.

        Raises:
            ValueError: the stage is not in the plan, or was there before.
        """
        if self._shares and name not in self._shares:
            raise ValueError(f"stage {name!r} is not in the plan: {', '.join(self._shares)}")
        if name in self._names:
            raise ValueError(f"stage {name!r} was there before: give its total for the whole run")
        if self._names:
            self._finished += self._shares.get(self._names[-1], 0.0)
        self._names.append(name)
        self._total, self._done, self._values = total, 0.0, {}
        self._stage_start = time.monotonic()
        self._first = (self._stage_start, 0.0)
        self._report(begins=True)

    def advance(self, n: int = 1, **values: float) -> None:
        """Count ``n`` more steps of the stage as done; ``values`` (losses, counts) are shown with it.

        Raises:
            RuntimeError: no stage has begun.
        """
        self.reach(self._done + n, **values)

    def reach(self, done: float, **values: float) -> None:
        """Set how many steps of the stage are done, parts of one too; ``values`` as for :meth:`advance`.

        Raises:
            RuntimeError: no stage has begun.
        """
        if not self._names:
            raise RuntimeError("reach() and advance() count the steps of a stage: call stage() first")
        if not self._done:
            self._first = (time.monotonic(), done)  # what compiles or loads does so in the first step
        self._done = done
        self._values.update(values)
        self._report(begins=False)

    @property
    def done(self) -> float:
        """Steps of the stage that are done."""
        return self._done

    @property
    def fraction(self) -> float:
        """Finished share of the run (of the stage, where there is no plan), in [0, 1]."""
        stage = min(1.0, self._done / self._total) if self._total > 0 else 0.0
        if not self._shares:
            return stage
        current = self._shares[self._names[-1]] if self._names else 0.0
        return min(1.0, self._finished + current * stage)

    @property
    def seconds_left(self) -> float | None:
        """Estimate for the run (for the stage, where there is no plan); None while nothing tells."""
        now = time.monotonic()
        since, counted = self._first
        if self._done < 2 * counted:
            # The first step, which loads and compiles, is still most of what there is to go by.
            since, counted = self._stage_start, 0.0
        if not self._done or self._done - counted <= _TOO_LITTLE * self._total:
            start = self._run_start if self._shares else self._stage_start
            return remaining(now - start, self.fraction) if self.fraction >= _TOO_EARLY else None
        pace = (now - since) / (self._done - counted)
        left = pace * max(0, self._total - self._done)
        if not self._shares:
            return left
        own = self._shares[self._names[-1]]
        later = max(0.0, 1 - self._finished - own)
        # What was compiled and loaded in this stage is not in the share of the later ones.
        return left + pace * self._total * later / own if own > 0 else left

    def close(self) -> None:
        """Take the bar off the screen, so that messages start on a clean line."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _report(self, begins: bool) -> None:
        if self._bar is not None:
            self._draw(self._bar, begins)
        elif begins or time.monotonic() - self._last_line >= self.interval:
            self._log()

    def _draw(self, bar: tqdm[Any], begins: bool) -> None:
        if begins and not self._shares:
            bar.reset()
        counted = f" {self._done:.0f}/{self._total}" if self._total > 1 else ""
        bar.set_description_str(self._names[-1] + counted, refresh=False)
        left = self.seconds_left
        told = [] if left is None else [f"about {clock(left)} left"]
        told += [f"{name}={value:.3g}" for name, value in self._values.items()]
        bar.set_postfix_str(", ".join(told), refresh=False)
        bar.update(self.fraction - bar.n)
        if begins:
            bar.refresh()

    def _log(self) -> None:
        self._last_line = time.monotonic()
        left = self.seconds_left
        data: dict[str, Any] = {
            "stage": self._names[-1],
            "done": round(self._done, 2),
            "total": self._total,
            "fraction": round(self.fraction, 4),
            "seconds_left": None if left is None else round(left),
            "values": dict(self._values),
        }
        parts = [self._names[-1] + (f" {self._done:.0f}/{self._total}" if self._total > 1 else "")]
        parts += [f"{name} {value:.4g}" for name, value in self._values.items()]
        parts += [] if left is None else [f"about {clock(left)} left"]
        logger.info(", ".join(parts), extra={"data": data})


def remaining(elapsed: float, fraction: float) -> float | None:
    """Seconds left if the rest of the work goes as fast as its first ``fraction`` did; None at the start."""
    return elapsed * (1 - fraction) / fraction if fraction > 0 else None


def clock(seconds: float) -> str:
    """A duration to read: ``45 s``, ``3 min``, ``1 h 05 min``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _open_bar() -> tqdm[Any]:
    from tqdm import tqdm

    return tqdm(
        total=1.0,
        bar_format=_BAR,
        file=sys.stderr,
        dynamic_ncols=True,
        leave=False,
        # Otherwise tqdm learns a step from a quick stage and then hardly redraws in a slow one.
        miniters=0,
    )
