"""A view in one frame, compared with the frames before, and what the next frame needs of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from morgs_mi.core.color_space import encode_light
from morgs_mi.core.view import View
from morgs_mi.method.active_set import ChangedView
from morgs_mi.method.exposure import Exposure


@dataclass(frozen=True, eq=False)
class ViewHistory:
    """Images of a view up to a frame, as a display shows them, uint8 [H, W, 3], in the exposure of
    the first one.
    """

    image: np.ndarray | None  #: Of that frame; None: the view has none.
    reference: np.ndarray  #: The next image is compared with it to detect changes.
    exposure: Exposure  #: Of the last image, relative to the first one.


@dataclass(frozen=True, eq=False)
class SeenView(ChangedView):
    """A view with its image in one frame, as a display shows it, uint8 [H, W, 3], in the exposure
    of the first one.
    """

    index: int = field(kw_only=True)  #: Among the training views.
    recorded: np.ndarray = field(kw_only=True)  #: The image as it was given.
    previous: np.ndarray | None = field(kw_only=True)  #: `image` of the frame before; None: none.
    history: ViewHistory = field(kw_only=True)  #: Images up to this frame.

    @cached_property
    def encoded(self) -> np.ndarray:
        """The image that the fit compares: `image` where uint8 was given, otherwise float32 with
        values above 1.
        """
        if self.recorded.dtype == np.uint8:
            return self.image
        return self.history.exposure.corrected(encode_light(self.recorded))

    def in_scene(self, exposures: Sequence[Exposure] = ()) -> View:
        """Return the view with the image that the fit compares, in the colours of the scene.

        Args:
            exposures: of all training views in the first frame; none: the image has these colours.
        """
        exposure = exposures[self.index] if exposures else Exposure()
        return self.at(exposure.corrected(self.encoded))
