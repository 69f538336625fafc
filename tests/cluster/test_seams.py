"""Seams: the start of a segment, and the approach of the one before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morgs_mi.cluster.seams import SeamConfig, approached, changed_packet, fit_seam_frame
from morgs_mi.codec.config import CodecConfig
from morgs_mi.codec.packets import CodedFrame, decode, keyframe_packet, reemitted_keyframe
from morgs_mi.stream_loop import StreamLoop
from tests.assertions import assert_close
from tests.scenes.coded_clip import CAMERAS, cloud
from tests.scenes.recording import CONFIG, recording

COUNT = 60
MOVED = ("log_scales", "quats", "logit_opacities", "sh_coeffs")


@pytest.fixture
def now() -> CodedFrame:
    return decode(None, keyframe_packet(cloud(COUNT), 3))


@pytest.fixture
def following(now: CodedFrame) -> CodedFrame:
    """The same Gaussians with other attributes; the first ten are elsewhere, the last ten are births."""
    other, raw = cloud(COUNT, seed=1).numpy(), now.gaussians.numpy()
    raw["means"][:10] += 5
    for name in MOVED:
        raw[name] = other[name]
    return replace(now, frame=4, gaussians=replace(now.gaussians, **raw))


def test_approached__reaches_the_same_gaussians_of_the_next_segment(now, following) -> None:
    raw = approached(now, following, COUNT - 10, 1.0, SeamConfig()).numpy()
    before, goal = now.gaussians.numpy(), following.gaussians.numpy()
    near = np.arange(COUNT)[10:-10]
    for name in ("means", *MOVED):
        value, sign = raw[name][near], 1
        if name == "quats":
            sign = np.sign((value * goal[name][near]).sum(1, keepdims=True))
        assert_close(value, sign * goal[name][near], atol=1e-6)
        for others in (slice(10), slice(-10, None)):
            np.testing.assert_array_equal(raw[name][others], before[name][others])


def test_approached__goes_a_share_of_the_way(now, following) -> None:
    raw = approached(now, following, COUNT, 0.25, SeamConfig()).numpy()["sh_coeffs"][10:]
    before, goal = (c.gaussians.numpy()["sh_coeffs"][10:] for c in (now, following))
    assert_close(raw, before + 0.25 * (goal - before), atol=1e-6)


def test_changed_packet__leads_to_the_gaussians_with_the_ids_of_the_frame(now) -> None:
    before = replace(now, frame=2)
    later = replace(now, ids=np.concatenate([now.ids[1:], [now.next_id]]).astype(np.uint32))
    changed = replace(now.gaussians, means=now.gaussians.numpy()["means"] + 0.5)
    coded = decode(before, changed_packet(before, later, changed, CAMERAS, CodecConfig()))
    np.testing.assert_array_equal(coded.ids, later.ids)
    assert_close(coded.gaussians.numpy()["means"], changed.numpy()["means"], atol=0.02)


def test_fit_seam_frame__leaves_what_is_static_as_it_is() -> None:
    capture = recording()
    settings = replace(CONFIG, fit=replace(CONFIG.fit, num_gaussians=400))
    loop = StreamLoop(capture.cameras, capture.points, capture.point_colors, settings)
    images = [dict(enumerate(frame.images)) for frame in capture.partial_frames(0, 5)]
    for frame in images[:2]:
        loop.push(list(frame.values()))
    base = loop.state.coded
    assert base is not None
    config = SeamConfig(passes=2, epochs=1)
    coded, report = fit_seam_frame(loop.setup, base, images[1], 4, images[4], config)
    assert (coded.frame, report.frame) == (4, 4)
    _, then, now = np.intersect1d(base.ids, coded.ids, return_indices=True)
    same = np.all(base.grid.values[then] == coded.grid.values[now], axis=1)
    assert 0.1 < same.mean() < 1
    assert decode(None, reemitted_keyframe(coded)).next_id >= base.next_id, "ids go on"


def test_fit_config__has_other_seeds_and_rates_for_each_pass() -> None:
    first, second = (SeamConfig(rates=3).fit_config(CONFIG, number) for number in (0, 1))
    assert first.seed != second.seed
    assert first.fit.rates.scales == pytest.approx(3 * CONFIG.fit.rates.scales)
