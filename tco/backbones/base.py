"""What test-time optimisation needs from a multi-view network."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from torch import nn

from tco.types import Prediction, Priors, SparseDepth, Views


@runtime_checkable
class Backbone(Protocol):
    """A multi-view network split into a frozen encoder and a decoder that adapters change.

    ``encode`` runs once per chunk, without gradients. ``decode`` runs every step, differentiably,
    for the views that a step needs. ``context`` is an earlier prediction for all views, which a
    network may use for the views that it does not decode now; networks that have no use for it
    ignore it.
    """

    name: str
    stride: int
    """Height and width of the canvas must be divisible by this."""
    uses_cameras: bool
    """True if the cameras are inputs and come back unchanged, False if they are predicted."""

    def encode(self, views: Views, priors: Priors) -> Any:
        """Features of all views that do not depend on the adapted weights."""
        ...

    def decode(
        self, encoded: Any, views: Sequence[int] | None = None, context: Prediction | None = None
    ) -> Prediction:
        """Predict the given views of the chunk (all if None)."""
        ...

    def with_points(self, encoded: Any, points: Mapping[int, SparseDepth]) -> Any:
        """The same features, with other sparse points as input for some views.

        Optimisation hides a part of the points from the network and asks it to predict them. A
        network that takes no points as input returns ``encoded`` itself.
        """
        ...

    def decoder(self) -> nn.Module:
        """The module whose layers test-time adapters may change."""
        ...


@runtime_checkable
class RunsAhead(Protocol):
    """A backbone that computes what comes before the first changed layer of its decoder only once."""

    def ahead(self, encoded: Any, changed: Collection[str]) -> Any:
        """The same features, with what no changed layer has a part in computed, without gradients.

        ``decode`` gives the same as before to the last bit, and goes on from there. The result is right for
        as long as no other layers change.

        Args:
            encoded: of :meth:`Backbone.encode`.
            changed: dotted names of the layers of :meth:`Backbone.decoder` that change.
        """
        ...


@runtime_checkable
class Drafts(Protocol):
    """A backbone that can say what it sees at a part of the resolution, for a part of the time."""

    def draft(self, encoded: Any) -> Prediction:
        """Depths and confidences of all views, and the cameras of maps of that size.

        Height and width are those of the canvas divided by one whole number. Its ``stages`` are such as
        ``decode`` finds in a context.
        """
        ...
