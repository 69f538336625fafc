"""Boundaries: the start of a chunk."""

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.codec.packets import decode, reemitted_keyframe
from morgs_mi.extras.cluster.tasks import ChunkConfig, fit_boundary_frame
from morgs_mi.stream_loop import StreamLoop
from tests.scenes.recording import CONFIG, recording


@pytest.mark.slow
def test_fit_boundary_frame__leaves_what_is_static_as_it_is():
    capture = recording()
    settings = replace(CONFIG, fit=replace(CONFIG.fit, num_gaussians=400))
    loop = StreamLoop(capture.cameras, capture.points, capture.point_colors, settings)
    images = [frame.images for frame in capture.partial_frames(0, 5)]
    for frame in images[:2]:
        loop.push(frame)
    base = loop.state.coded
    config = ChunkConfig(passes=2, epochs=1)
    coded, report = fit_boundary_frame(loop.setup, loop.state, 4, images[4], config)
    assert (coded.frame, report.frame) == (4, 4)
    _, base_rows, coded_rows = np.intersect1d(base.ids, coded.ids, return_indices=True)
    same = np.all(base.grid.values[base_rows] == coded.grid.values[coded_rows], axis=1)
    assert 0.1 < same.mean() < 1
    assert decode(None, reemitted_keyframe(coded)).next_id >= base.next_id, "ids go on"


def test_fit_config__has_other_seeds_and_rates_for_each_pass():
    first, second = (ChunkConfig().fit_config(CONFIG, number) for number in (0, 1))
    assert first.seed != second.seed
    assert first.fit.rates.scales == pytest.approx(2 * CONFIG.fit.rates.scales)
