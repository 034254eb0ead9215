"""The pictures of all views at the network's size, made once for all the chunks that hold them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from colmap_tco._pycolmap import camera_size
from colmap_tco.views import Band, Picture, View, resized, sampling, undistorted_image

KEPT = 500_000_000
"""Bytes of pictures that are kept: of 780 views at 256 pixels. Others used longest ago are made anew."""
LARGEST_SAMPLING = 40_000_000
"""Pixels of an undistorted image up to which the places of its pixels, 9 bytes for each, are kept."""

Take = Callable[[View, NDArray[np.uint8]], None]
"""Is given a view and its undistorted image (H, W, 3)."""


class Pictures:
    """Makes the pictures of views for the network, and keeps them for the next chunk that asks.

    To read and undistort a large photo takes longer than to predict its depths, and a view that helps its
    neighbours is in several chunks. Of the camera of the last view it keeps the places of all pixels, too:
    most often it is that of all the others.
    """

    def __init__(self, take: Take, kept: int = KEPT) -> None:
        """Hand each undistorted image, which is not kept, to ``take``; keep so many bytes of pictures."""
        self._take, self._limit = take, kept
        self._held: OrderedDict[str, Picture] = OrderedDict()
        self._bytes = 0
        self._camera: object = None
        self._bands: list[Band] = []

    def __call__(self, view: View) -> Picture:
        """The picture of a view.

        Raises:
            InputError: the image or its mask cannot be read or has another size than the camera.
        """
        if view.name in self._held:
            self._held.move_to_end(view.name)
            return self._held[view.name]
        image, valid = undistorted_image(view, self._sampling(view))
        self._take(view, image)
        made = self._held[view.name] = resized(view, image, valid)
        self._bytes += _size(made)
        while self._bytes > self._limit and len(self._held) > 1:
            self._bytes -= _size(self._held.popitem(last=False)[1])
        return made

    def _sampling(self, view: View) -> list[Band] | None:
        """Where the pixels of the view come from, if that is to be kept."""
        if view.camera.width * view.camera.height > LARGEST_SAMPLING:
            return None
        c = view.original
        camera = (c.model.name, camera_size(c), tuple(map(float, c.params)), view.camera)
        if camera != self._camera:
            self._bands = list(sampling(view))
            self._camera = camera
        return self._bands


def _size(picture: Picture) -> int:
    return sum(part.nbytes for part in picture)
