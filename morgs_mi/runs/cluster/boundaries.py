"""Boundaries: starts of chunks, where the stream continues with other Gaussians.

All chunks start from one common model, the first two frames of the recording. A chunk is fitted
from some frames before its first one (*overlap*). The first of these is fitted like a later frame
of the common model, several times over, until Gaussians that have travelled far since then arrive;
the others follow as usual. What has not changed since the first frames stays as it is, to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge

from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.config import config_class
from morgs_mi.loop.frame_report import FrameReport
from morgs_mi.loop.observation import Setup
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.stream_loop import StreamState, step

COMMON_FRAMES = 2
"""Frames of the common model: the second one determines the confidence."""

# Factor on the learning rates of the fits of the first frame: there is further to go than between
# two frames.
_RATES = 2.0
# Largest number of births in each of them, as a fraction of the Gaussians.
_BIRTHS = 0.1
# Factor on the epochs of the other frames: the fit is not yet as good as one that followed from the
# beginning.
_OVERLAP_EPOCHS = 2


@config_class
class ChunkConfig:
    """Chunks of a fit, and the boundaries between them."""

    count: int = 1
    """Number of chunks of about the same length, of two frames at least; with one, the stream
    equals `stream_capture`'s."""
    passes: Annotated[int, Ge(1)] = 24
    """Fits of the first frame of the overlap, one after the other, each with a round of density
    control.
    """
    epochs: Annotated[int, Ge(1)] = 4
    """Passes over all training views in each of them."""
    overlap: Annotated[int, Ge(0)] = 10
    """Frames before a chunk that are fitted as well: its Gaussians then follow the recording from
    its first frame.
    """

    def overlap_config(self, config: StreamConfig) -> StreamConfig:
        """Return the settings of the other frames of the overlap."""
        return replace(config, fit=replace(config.fit, epochs=_OVERLAP_EPOCHS * config.fit.epochs))

    def fit_config(self, config: StreamConfig, number: int) -> StreamConfig:
        """Return the settings of one of these fits."""
        rates = {name: _RATES * rate for name, rate in asdict(config.fit.rates).items()}
        fit = replace(
            config.fit,
            epochs=self.epochs,
            rates=replace(config.fit.rates, **rates),
            density=replace(config.fit.density, births=_BIRTHS),
            early_stopping_tolerance=0.0,
        )
        return replace(config, fit=fit, seed=config.seed + number)


def fit_boundary_frame(
    setup: Setup,
    common: StreamState,
    frame: int,
    images: Sequence[np.ndarray | None],
    config: ChunkConfig,
) -> tuple[CodedFrame, FrameReport]:
    """Fit a frame far from the common model, and return its state and its report.

    Args:
        setup: what all frames share.
        common: the common model, after its last frame.
        frame: the frame.
        images: its images, in the order of the views; None where a view has none.
        config: settings.
    """
    # Motion over many frames is no speed.
    setup = replace(setup, cameras=tuple(camera.without_delays() for camera in setup.cameras))
    coded = common.coded
    assert coded is not None
    history = common.history
    seconds = 0.0
    for number in range(config.passes):
        pass_setup = replace(setup, config=config.fit_config(setup.config, number))
        state = replace(common, frame=frame, coded=replace(coded, frame=frame - 1), history=history)
        state, _, report = step(pass_setup, state, images)
        coded = state.coded
        assert coded is not None
        # Changes are relative to the common model again.
        history = replace(common.history, images=state.history.images)
        seconds += report.seconds
    return coded, replace(report, seconds=seconds)
