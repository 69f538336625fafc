"""The loop: causal, pure, repeatable, without drift, and cheap where nothing moves."""

from __future__ import annotations

import copy
import dataclasses
import gc
import json
import threading
from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import Camera, Gaussians, rasterize, stream_loop
from morgs_mi.capture.capture import Capture, PartialFrame
from morgs_mi.codec.container import PacketKind
from morgs_mi.codec.packets import coded_frames, decode
from morgs_mi.codec.reader import StreamReader
from morgs_mi.core.color_space import SH_C0, decode_light, encode_light
from morgs_mi.evaluate.metrics import endpoint_error, psnr
from morgs_mi.fit.fit_config import DensityConfig, FitConfig, LearningRates, ShortFitConfig
from morgs_mi.loop import observation
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.runs.fit_capture import stream_capture
from morgs_mi.stream_loop import StreamLoop
from tests.quick import NO_DENSITY, quick
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.gaussians import isotropic
from tests.scenes.textured import render, rig, textures

SHIFT = np.array([0.06, 0.02, 0.0])  # about 3 px a frame
QUICK = quick(  # from all points, as the images were made of them
    MotionConfig(key_views=2),
    num_gaussians=600,
    first_frame_steps=150,
    dropout=0.0,
    confidence_steps=20,
    epochs=4,
    density=NO_DENSITY,
)
SHORT = dataclasses.replace(QUICK, fit=dataclasses.replace(QUICK.fit, first_frame_steps=20))


def scene(frame: float) -> tuple[Gaussians, np.ndarray]:
    """A textured ball that moves by SHIFT in front of a static textured wall; and the mask of the
    moving Gaussians.

    The wall is thick: its Gaussians lie in the same order in every view.
    """
    rng = np.random.default_rng(0)
    wall = rng.uniform((-2.4, -2.0, 0.6), (2.4, 2.0, 2.0), (500, 3))
    direction = rng.normal(size=(120, 3))
    ball = (
        0.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        + (-0.2, 0, -0.4)
        + frame * SHIFT
    )
    moves = np.r_[np.zeros(len(wall), bool), np.ones(len(ball), bool)]
    sh = rng.uniform(-1.6, 1.6, (len(moves), 1, 3))
    return isotropic(np.concatenate([wall, ball]), np.where(moves, 0.09, 0.16), 0.95, sh), moves


def cameras() -> list[Camera]:
    return look_at_cameras([*QUAD, (0, 0, -3.5)], 50, 96, 72, [f"cam{i:02d}" for i in range(5)])


def shown(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return an image of Gaussians in 8 bits."""
    return np.uint8(
        np.clip(np.asarray(rasterize(gaussians, camera, ("color",)).color), 0, 1) * 255 + 0.5
    )


@pytest.fixture(scope="module")
def clip():
    """Five views, four frames; the last view is held out."""
    return [[shown(scene(t)[0], camera) for camera in cameras()] for t in range(4)]


def points_and_colors():
    points = scene(0)[0].numpy()
    return points["means"], np.clip(points["sh_coeffs"][:, 0] * SH_C0 + 0.5, 0, 1)


def new_loop(config=QUICK):
    return StreamLoop(cameras()[:4], *points_and_colors(), config)


def run(clip, config=QUICK, frames=3):
    loop = new_loop(config)
    packets, reports = zip(*(loop.push(images[:4]) for images in clip[:frames]), strict=True)
    return loop, packets, reports


@pytest.fixture(scope="module")
def first(clip):
    """The first frame; a copy of its loop continues from there."""
    return run(clip, frames=1)


@pytest.fixture(scope="module")
def full(clip, first):
    loop = copy.copy(first[0])
    packets, reports = first[1:]
    later_packets, later_reports = zip(
        *(loop.push(images[:4]) for images in clip[1:3]), strict=True
    )
    return loop, (*packets, *later_packets), (*reports, *later_reports)


def held_out(loop_or_gaussians, channels=("color", "motion", "confidence")):
    return rasterize(loop_or_gaussians, cameras()[4], channels)


def test_push__reconstructs_the_first_frame_in_the_held_out_view(clip, first):
    loop, _, reports = first
    image = np.clip(np.asarray(held_out(loop.gaussians, ("color",)).color), 0, 1)
    # 150 steps on the points that made the image; the wall alone, without the ball, gives 17 dB.
    assert psnr(image, clip[0][4] / 255) > 26
    assert reports[0].status == "ok"


@pytest.mark.slow
def test_push__motion_follows_the_truth_and_not_the_static_wall(full):
    """The modules' claim: per-Gaussian motion is the scene's, not the residual's."""
    loop, _, reports = full
    maps = held_out(loop.gaussians)
    means = scene(1)[0].numpy()["means"]
    state = scene(2)[0]
    truth = rasterize(
        dataclasses.replace(state, motion=state.numpy()["means"] - means), cameras()[4], ("motion",)
    )
    truth = np.asarray(truth.motion)
    motion = np.asarray(maps.motion)
    moving = np.linalg.norm(truth, axis=-1) > 1.5
    assert 0.03 < moving.mean() < 0.4
    assert endpoint_error(motion, truth, moving) < 0.5 * endpoint_error(
        np.zeros_like(truth), truth, moving
    )
    still = np.linalg.norm(truth, axis=-1) < 0.01
    assert endpoint_error(motion, truth, still) < 0.5
    assert {"recon", "flow", "offset"} <= reports[2].losses.keys()


@pytest.mark.slow
def test_push__confidence_is_high_where_things_move(full):
    loop = full[0]
    confidence = np.asarray(held_out(loop.gaussians).confidence)[..., 0]
    _, moves = scene(2)
    labelled = dataclasses.replace(scene(2)[0], logit_confidence=np.where(moves, 20.0, -20.0))
    truth = np.asarray(held_out(labelled, ("confidence",)).confidence)[..., 0]
    assert confidence[truth > 0.9].mean() > confidence[truth < 0.1].mean() + 0.4


def test_push__decoder_has_the_encoders_state_to_the_bit(full):
    loop, packets, _ = full
    *_, decoded = coded_frames(packets)
    assert decoded.frame == 2
    state = loop.gaussians.numpy()
    for name, value in decoded.gaussians.numpy().items():
        assert np.array_equal(value, state[name]), name


def test_push__returns_a_keyframe_and_then_residuals(full):
    _, packets, reports = full
    assert [p.kind for p in packets] == [
        PacketKind.KEYFRAME,
        PacketKind.RESIDUAL,
        PacketKind.RESIDUAL,
    ]
    assert [r.frame for r in reports] == [p.frame for p in packets] == [0, 1, 2]
    with pytest.raises(ValueError, match="it does not continue a state; a packet is missing"):
        decode(None, packets[1])


def test_push__same_seed_gives_the_same_bytes_and_no_frame_looks_ahead(clip):
    """Packets do not depend on later frames, to the byte where sums have a fixed order."""
    density = DensityConfig(rounds=2, births=0.05, min_error=0)
    fit = dataclasses.replace(QUICK.fit, density=density, first_frame_steps=40)
    config = dataclasses.replace(QUICK, fit=fit)
    dark = [clip[0], clip[1], [np.zeros_like(image) for image in clip[2]]]
    runs = [[packet.encoded for packet in run(frames, config)[1]] for frames in (clip, dark)]
    assert runs[0][:2] == runs[1][:2]
    assert runs[0][2] != runs[1][2]


@pytest.mark.slow
def test_push__stream_carries_births_and_deaths(clip):
    """Faint ones are pruned, no more are added than the limit allows, ids are never reused, and the
    decoder has all.
    """
    density = DensityConfig(rounds=0, births=0.05, max_gaussians=590, min_error=0, min_opacity=0.3)
    loop, packets, reports = run(
        clip, dataclasses.replace(QUICK, fit=dataclasses.replace(QUICK.fit, density=density))
    )
    frames = list(coded_frames(packets))
    for state, next_state, report in zip(frames, frames[1:], reports[1:], strict=False):
        births = np.setdiff1d(next_state.ids, state.ids)
        survivors = len(np.intersect1d(next_state.ids, state.ids))
        assert births.tolist() == list(range(state.next_id, state.next_id + len(births)))
        assert 0 < len(births) == min(round(0.05 * len(state.ids)), 590 - survivors)
        assert report.num_gaussians == survivors + len(births)
    assert len(np.intersect1d(frames[0].ids, frames[2].ids)) < 590
    for name, value in frames[-1].gaussians.numpy().items():
        assert np.array_equal(value, loop.gaussians.numpy()[name]), name


@pytest.mark.slow
def test_push__fits_views_at_their_own_times(clip):
    """Two of four views are half a frame late and two half a frame early; at the timestamps nobody
    saw the ball.
    """
    delays = (0.5, -0.5, 0.5, -0.5)
    views = [dataclasses.replace(c, delay=d) for c, d in zip(cameras()[:4], delays, strict=True)]
    frames = [
        [shown(scene(t + d)[0], c) for c, d in zip(views, delays, strict=True)] for t in range(3)
    ]
    quality = []
    for assumption, first in ((views, clip[0][:4]), (cameras()[:4], frames[0])):
        loop = StreamLoop(assumption, *points_and_colors(), QUICK)
        loop.push(first, recorded=frames[0])
        for images in frames[1:]:
            loop.push(images)
        quality.append(np.mean([moving_psnr(loop, clip, view) for view in range(4)]))
    assert quality[0] > quality[1] + 1.5


def moving_psnr(loop: StreamLoop, clip, view: int) -> float:
    """Return the PSNR of a view at frame 2, where it has changed."""
    mask = np.abs(np.int16(clip[2][view]) - clip[1][view]).max(axis=-1) > 20
    color = np.clip(np.asarray(rasterize(loop.gaussians, cameras()[view], ("color",)).color), 0, 1)
    return psnr(color[mask], clip[2][view][mask] / 255.0)


@pytest.mark.slow
def test_push__modules_can_be_switched_off(clip):
    off = dataclasses.replace(
        QUICK, motion=MotionConfig(learn_motion=False, learn_offset=False, learn_confidence=False)
    )
    _, _, reports = run(clip, off, frames=2)
    assert reports[1].losses.keys() == {"recon"}
    masked = dataclasses.replace(
        QUICK, motion=MotionConfig(key_views=2, mask_interval=1, learn_offset=False)
    )
    _, _, reports = run(clip, masked, frames=2)
    assert reports[1].losses.keys() == {"recon", "flow", "mask"}


@pytest.mark.slow
def test_push__replaces_too_few_points_and_reports_it(clip):
    """Half of the Gaussians are seeded, the others are added by density control."""
    config = dataclasses.replace(QUICK, fit=dataclasses.replace(QUICK.fit, density=DensityConfig()))
    loop = StreamLoop(cameras()[:4], np.zeros((0, 3)), np.zeros((0, 3)), config)
    _, report = loop.push(clip[0][:4])
    assert "0 points, too few: seeded 300" in report.status
    assert 590 < len(loop.gaussians) <= 600  # those pruned in the last round are not replaced


@pytest.mark.slow
def test_push__forecasts_other_views(clip):
    _, report = new_loop(SHORT).push(clip[0][:4])
    validation = report.validation
    assert validation["sentence"].startswith(
        f"Views between the cameras will be {validation['quality']}"
    )
    assert {"spacing", "overlap", "reach"} < validation.keys()


@pytest.mark.slow
def test_push__forecasts_nothing_of_a_single_camera(clip):
    loop = StreamLoop(cameras()[:1], *points_and_colors(), QUICK)
    assert loop.push(clip[0][:1])[1].validation == {}


@pytest.mark.slow
def test_push__fits_the_first_frame_in_the_steps_that_a_time_allows(clip):
    ticks = []
    fit = dataclasses.replace(QUICK.fit, first_frame_steps=None, first_frame_seconds=1e-3)
    hardly_any = dataclasses.replace(QUICK, fit=fit)
    _, report = new_loop(hardly_any).push(clip[0][:4], lambda *tick: ticks.append(tick))
    assert report.steps == 100
    assert ticks[-1][0].startswith("First frame, about ")
    assert ticks[-1][1:] == (100, 100)


def without(images, *views):
    return [None if view in views else image for view, image in enumerate(images[:4])]


@pytest.mark.slow
def test_push__without_an_image_of_one_view(clip, first, monkeypatch):
    """Flow on two key views out of those that have both images: not of the missing view, nor when
    it is back.
    """
    flow_views = []
    observe = observation.observe_key_views
    monkeypatch.setattr(
        observation,
        "observe_key_views",
        lambda pairs, *more: (
            flow_views.append({p.camera for p in pairs.values()}) or observe(pairs, *more)
        ),
    )
    loop = copy.copy(first[0])
    usual = {cameras()[view].name for view in loop.setup.key_views}
    gone = loop.setup.key_views[0]

    def scores() -> list[float]:
        shown = np.clip(np.asarray(held_out(loop.gaussians, ("color",)).color), 0, 1)
        return [psnr(shown, images[4] / 255) for images in clip]

    score_list = [scores()]
    missing = []
    for images in (without(clip[1], gone), clip[2][:4], clip[3][:4]):
        missing.append(loop.push(images)[1].missing_views)
        score_list.append(scores())
    assert missing == [(f"cam{gone:02d}",), (), ()]
    assert [len(views) for views in flow_views] == [2, 2, 2]
    assert all(f"cam{gone:02d}" not in views for views in flow_views[:2])
    assert flow_views[2] == usual
    # Every frame follows the motion, from three of four views too: it shows its own timestamp
    # better than the last did.
    assert all(score_list[t][t] > score_list[t - 1][t] + 1 for t in (1, 2, 3)), score_list


@pytest.mark.slow
def test_push__without_any_image_nothing_moves(clip):
    loop = new_loop()
    first, _ = loop.push(without(clip[0], 1))
    old_values = loop.gaussians.numpy()
    packet, report = loop.push([None] * 4)
    assert report.status == "no view has an image"
    assert report.missing_views == ("cam00", "cam01", "cam02", "cam03")
    # The packet's frame, and nothing in it.
    assert report.num_bytes < 200 < len(first.encoded)
    for name, value in loop.gaussians.numpy().items():
        assert name == "motion" or np.array_equal(value, old_values[name]), name
    packet, report = loop.push(clip[1][:4])
    assert (packet.frame, report.status, report.missing_views) == (2, "ok", ())
    assert "flow" not in report.losses


@pytest.mark.slow
def test_stream_capture__writes_a_file(clip, tmp_path):
    class Recorded(Capture):
        def partial_frames(self, start=0, stop=None):
            yield from (PartialFrame(i, tuple(images)) for i, images in enumerate(clip[:2]))

        def metadata(self):
            return {"layout": "in memory"}

    points = scene(0)[0].numpy()
    capture = Recorded(
        path=tmp_path,
        cameras=tuple(cameras()),
        num_frames=2,
        fps=30.0,
        points=points["means"],
        point_colors=np.full((len(points["means"]), 3), 0.5, np.float32),
        masks=(None,) * 5,
        test_views=(4,),
        truth=None,
        _sources=(),
        downscale=2,
    )
    ticks = []
    reports = stream_capture(
        capture, tmp_path / "out", QUICK, progress=lambda *tick: ticks.append(tick)
    )
    path = tmp_path / "out" / "stream.morgs"
    reader = StreamReader(path)
    assert [c.name for c in reader.cameras] == [c.name for c in cameras()]
    assert (reader.metadata["train_views"], reader.metadata["downscale"]) == ([0, 1, 2, 3], 2)
    assert [state.frame for state in reader.states()] == [0, 1]
    assert sum(r.num_bytes for r in reports) < path.stat().st_size
    assert ticks[-1] == ("Later frames", 1, 1)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "capture.json",
        "report.json",
        "stream.morgs",
    ]
    settings = json.loads((tmp_path / "out" / "capture.json").read_text())
    assert settings == {"layout": "in memory", "capture": str(capture.path)}


def masked(masks):
    return StreamLoop(cameras()[:4], [], [], masks=masks)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda clip: StreamLoop([], np.zeros((0, 3)), np.zeros((0, 3))), "at least one view"),
        (
            lambda clip: StreamLoop([mi.load_dict(cameras()[0].sensor())], [], []),
            r"got a ProjectiveCamera; convert a Mitsuba sensor by Camera.from_sensor\(\)",
        ),
        (lambda clip: new_loop().push(clip[0][:3]), "one image or None for each of 4 views, got 3"),
        (
            lambda clip: new_loop().push([None] * 4),
            "frame 0 must have an image of at least one view, got none",
        ),
        (
            lambda clip: new_loop().push([i[:50] for i in clip[0][:4]]),
            r"view 'cam00' must be uint8 \[72, 96, 3\]",
        ),
        (lambda clip: new_loop().push([i.astype(int) for i in clip[0][:4]]), "got int64"),
        (
            lambda clip: new_loop().push([np.full(i.shape, np.nan) for i in clip[0][:4]]),
            "must be finite and at most 1e",
        ),
        (
            lambda clip: StreamLoop(cameras(), np.full((200, 3), np.nan), np.zeros((200, 3))),
            r"`points` must be finite and at most 1e\+12, got .* at 0",
        ),
        (
            lambda clip: StreamLoop(cameras(), np.zeros((200, 3)), np.zeros((10, 3))),
            r"`points` and `point_colors` must be \[P, 3\], got \[200, 3\] and",
        ),
        (
            lambda clip: StreamLoop(cameras(), np.zeros((3, 4)), np.zeros((4, 3))),
            r"`points` and `point_colors` must be \[P, 3\]",
        ),
        (
            lambda clip: StreamLoop(cameras(), np.zeros((200, 3)), np.full((200, 3), 128)),
            r"`point_colors` must be in \[0, 32\], got .* at 0; divide colours of 8 bits by 255",
        ),
        (lambda clip: masked([None]), "one mask or None for each of 4 views, got 1"),
        (
            lambda clip: masked([None, np.ones((50, 96), bool), None, None]),
            r"view 'cam01': the mask must be bool \[72",
        ),
        (lambda clip: masked([np.ones((72, 96), np.uint8), None, None, None]), "got uint8"),
        (lambda clip: StreamLoop(["cam00"], [], []), "`cameras` must be a .*Camera, got a str"),
        (
            lambda clip: StreamLoop(cameras(), [], [], {}),
            "`config` must be a .*StreamConfig, got a dict",
        ),
        (
            lambda clip: new_loop().push(None),
            "one image or None for each of 4 views, got a NoneType",
        ),
        (lambda clip: new_loop().push(["a", None, None, None]), "got str; convert it"),
        (lambda clip: FitConfig(epochs=0), "`epochs` must be at least 1, got 0"),
        (
            lambda clip: LearningRates(means=np.nan),
            "`means` must be a finite number, at least 0, got nan",
        ),
        (
            lambda clip: FitConfig(sh_degree=4),
            "`sh_degree` must be at least 0 and at most 3, got 4",
        ),
        (lambda clip: MotionConfig(key_views=0), "`key_views` must be at least 1, got 0"),
    ],
)
def test_stream_loop__refuses_bad_input(clip, call, message):
    with pytest.raises(ValueError, match=message):
        call(clip)


@pytest.mark.slow
def test_push__a_static_clip_costs_next_to_nothing(clip):
    """Camera noise of 2 grey levels is no change: nothing is active, and the packets have a few
    bytes.
    """
    rng = np.random.default_rng(0)

    def recorded(frame):
        return [
            np.uint8(np.clip(image + rng.normal(0, 2, image.shape), 0, 255))
            for image in clip[frame][:4]
        ]

    loop = new_loop()
    loop.push(recorded(0))
    still = [loop.push(recorded(0))[1] for _ in range(3)]
    _, moving = loop.push(recorded(1))
    for report in still:
        assert set(report.active.values()) == {0}
        assert report.losses == {}
        assert report.num_bytes < 200  # heads of a packet and of its groups
    # A twentieth on images of a usual size; a busy machine may delay some of the frames.
    assert min(report.seconds for report in still) < 0.2 * moving.seconds
    assert 0.1 < moving.active["gaussians"] < 0.9
    assert moving.active["views"] == 1


@pytest.mark.slow
def test_push__skipping_static_views_costs_no_quality(clip):
    """The held-out image is as good in the mean of eight seeds, in fewer bytes."""
    quality = np.zeros((8, 2))
    sizes = np.zeros((8, 2))
    for seed in range(8):
        begun = new_loop(dataclasses.replace(QUICK, seed=seed))
        begun.push(clip[0][:4])
        for column, skip in enumerate((True, False)):
            fit = dataclasses.replace(QUICK.fit, skip_static=skip)
            loop = new_loop(dataclasses.replace(QUICK, fit=fit, seed=seed))
            loop.state = begun.state  # the first frame skips nothing
            reports = [loop.push(images[:4])[1] for images in clip[1:3]]
            image = np.asarray(rasterize(loop.gaussians, cameras()[4], ("color",)).color)
            quality[seed, column] = psnr(np.clip(image, 0, 1), clip[2][4] / 255)
            sizes[seed, column] = sum(report.num_bytes for report in reports)
            assert (reports[-1].active["pixels"] < 1) == skip
    # One seed differs by up to a decibel: five small views, and a first frame that is far from
    # done.
    assert quality[:, 0].mean() > quality[:, 1].mean() - 0.3
    assert np.all(sizes[:, 0] < 0.9 * sizes[:, 1])


def test_step__is_pure_and_complete(clip):
    """With default settings, called twice in a row and again from the same state; the caller's
    images may be reused.
    """
    config = StreamConfig(fit=dataclasses.replace(QUICK.fit, first_frame_steps=60, dropout=None))
    setup = observation.prepare(cameras()[:4], *points_and_colors(), config)
    start = stream_loop.StreamState()
    buffers = [image.copy() for image in clip[0][:4]]
    first, keyframe, _ = stream_loop.step(setup, start, buffers)
    for buffer, image in zip(buffers, clip[1][:4], strict=True):
        buffer[:] = image
    second, residual, report = stream_loop.step(setup, first, buffers)
    third, _, _ = stream_loop.step(setup, second, clip[2][:4])
    assert (start.frame, first.frame, second.frame, third.frame) == (0, 1, 2, 3)
    assert report.active["gaussians"] > 0.1, "a refilled buffer must not pass for a static clip"
    assert (keyframe.frame, residual.frame) == (0, 1)
    decoded = decode(decode(None, keyframe), residual).gaussians.numpy()
    for name, value in second.gaussians.numpy().items():
        assert np.array_equal(value, decoded[name]), name
    again, _, _ = stream_loop.step(setup, first, clip[1][:4])
    assert again.frame == 2
    assert first.frame == 1


def test_resume__copies_its_images_and_refuses_those_of_another_size(clip, full):
    loop = new_loop()
    buffers = [image.copy() for image in clip[0][:4]]
    coded = full[0].state.coded
    loop.resume(coded, [buffers])
    for buffer in buffers:
        buffer[:] = 0
    assert all(np.array_equal(loop.state.history.images[view], clip[0][view]) for view in range(4))
    with pytest.raises(ValueError, match=r"must be uint8 \[72, 96, 3\]"):
        loop.resume(coded, [[image[:50] for image in buffers]])


def pushed_ahead(loop, clip, upcoming):
    """Return the packets of all frames but the last, pushed with what `upcoming` makes of the next
    frame's images.
    """
    packets = []
    for images, following in pairwise(clip):
        ahead = upcoming(following[:4])
        packets.append(loop.push(images[:4], upcoming=ahead)[0])
        for image in ahead or ():
            image[:] = 0  # it belongs to the caller again
    return packets


@pytest.fixture(scope="module")
def reproducible(clip):
    """The first frame with sums of a fixed order."""
    return run(clip, QUICK, frames=1)


@pytest.fixture(scope="module")
def plain(clip, reproducible):
    """The packets of three frames."""
    loop = copy.copy(reproducible[0])
    packets = reproducible[1]
    return [
        packet.encoded for packet in (*packets, *pushed_ahead(loop, clip[1:], lambda images: None))
    ]


@pytest.mark.slow
def test_push__observes_the_upcoming_frame_in_another_thread_and_changes_nothing(
    clip, plain, monkeypatch
):
    threads = []
    observe = stream_loop.observe_frame
    monkeypatch.setattr(
        stream_loop,
        "observe_frame",
        lambda *args: threads.append(threading.current_thread()) or observe(*args),
    )
    loop = new_loop(QUICK)
    ahead = pushed_ahead(loop, clip, lambda images: [image.copy() for image in images])
    assert threads[0] is threading.main_thread()
    assert len(threads) == 4
    assert threading.main_thread() not in threads[1:]
    assert [packet.encoded for packet in ahead] == plain


@pytest.mark.slow
def test_push__uses_no_observation_of_other_images(clip, reproducible, plain):
    wrong = pushed_ahead(
        copy.copy(reproducible[0]), clip[1:], lambda images: [image // 2 for image in images]
    )
    assert [packet.encoded for packet in wrong] == plain[1:]


def test_push__refuses_upcoming_images_of_another_size_in_their_turn(clip, first):
    loop = copy.copy(first[0])
    small = [image[:50] for image in clip[2][:4]]
    loop.push(clip[1][:4], upcoming=small)
    with pytest.raises(ValueError, match=r"frame 2 of view 'cam00' must be uint8 \[72, 96, 3\]"):
        loop.push(small)
    loop.push(clip[2][:4])
    assert loop.state.frame == 3


EXPOSED = dataclasses.replace(
    QUICK,
    fit=dataclasses.replace(
        QUICK.fit, exposure="on", short_fits=ShortFitConfig(gaussians=600, steps=60, rounds=2)
    ),
)


def brighter(images, gains):
    """Return the images of a frame with a gain per view."""
    return [
        np.rint(np.clip(g * image, 0, 255)).astype(np.uint8)
        for g, image in zip(gains, images, strict=True)
    ]


@pytest.fixture(scope="module")
def auto_exposed(clip):
    """A static clip of cameras that differ, and change by up to 10 % in each frame; reports of a
    fit with exposures.
    """
    gains = [(0.9, 1.0, 0.95, 0.85), (0.9, 1.1, 0.95, 0.75), (1.0, 0.9, 0.9, 0.85)]
    frames = [brighter(clip[0][:4], each) for each in gains]
    loop = new_loop(EXPOSED)
    return np.array(gains), frames, loop, [loop.push(images)[1] for images in frames]


@pytest.mark.slow
def test_push__reports_the_exposure_of_each_view_over_time(auto_exposed):
    gains, _, _, reports = auto_exposed
    middle = (
        np.array([[np.mean(e(0.4 * np.ones(3))) for e in report.exposures] for report in reports])
        / 0.4
    )
    np.testing.assert_allclose(middle / middle[0], gains / gains[0], atol=0.01)
    assert np.abs(np.log(middle[0])).max() > 0.02, "the cameras differ in the first frame, too"
    assert "The cameras were balanced" in reports[0].validation["exposure"]["sentence"]


@pytest.mark.slow
def test_push__changes_no_static_gaussian_where_only_the_exposure_changes(auto_exposed):
    _, frames, _, reports = auto_exposed
    plain = new_loop(
        dataclasses.replace(EXPOSED, fit=dataclasses.replace(EXPOSED.fit, exposure="off"))
    )
    without = [plain.push(images)[1] for images in frames]
    assert max(report.num_bytes for report in reports[1:]) < 0.1 * min(
        report.num_bytes for report in without[1:]
    )
    assert without[0].exposures == ()


@pytest.mark.slow
def test_resume__continues_with_the_exposures_of_the_reports(auto_exposed, clip):
    gains, frames, loop, reports = auto_exposed
    following = brighter(clip[1][:4], gains[1])
    packet, report = stream_loop.step(loop.setup, loop.state, following)[1:]
    resumed = new_loop(EXPOSED)
    resumed.resume(loop.state.coded, frames, reports[0].exposures)
    again, same = resumed.push(following)
    assert again.encoded == packet.encoded
    assert same.exposures == report.exposures


@pytest.mark.slow
def test_push__leaves_a_change_of_light_in_the_scene(clip):
    loop = new_loop(EXPOSED)
    frames = [clip[0][:4], brighter(clip[0][:4], [0.8] * 4)]
    reports = [loop.push(images)[1] for images in frames]
    # All cameras see it: the stream becomes darker, and no exposure changes.
    assert reports[1].exposures == reports[0].exposures
    assert reports[1].num_bytes > 1000


@pytest.mark.slow
def test_push__has_the_same_bytes_with_exposures_where_cameras_are_equal(clip, plain, monkeypatch):
    # Their few short fits would find differences of 1 %.
    monkeypatch.setattr("morgs_mi.fit.balance.LEAST_DIFFERENCE", 0.1)
    loop = new_loop(
        dataclasses.replace(EXPOSED, fit=dataclasses.replace(EXPOSED.fit, exposure="auto"))
    )
    assert [loop.push(images[:4])[0].encoded for images in clip[:3]] == plain


def garbage_of(action) -> list[object]:
    """Return what only a garbage collection frees after an action."""
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        action()
        gc.collect()
        return list(gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()


@pytest.mark.slow
def test_push__leaves_no_arrays_to_the_garbage_collection(clip):
    """It may run in any thread, where freeing arrays of Dr.Jit can end the process."""
    loop = StreamLoop(cameras()[:4], *points_and_colors(), QUICK)
    loop.push(clip[0][:4])
    assert garbage_of(lambda: loop.push(clip[1][:4])) == []


@pytest.mark.slow
def test_push__is_interrupted_in_a_callback_and_continues(clip, monkeypatch):
    """Dr.Jit turns the interruption into a RuntimeError; the loop is as it was before the frame."""
    loop, other = (StreamLoop(cameras()[:4], *points_and_colors(), QUICK) for _ in range(2))
    packets = [other.push(images[:4])[0].encoded for images in clip[:2]]
    first, _ = loop.push(clip[0][:4])

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def interrupted() -> None:
        with pytest.raises(KeyboardInterrupt):
            loop.push(clip[1][:4])

    with monkeypatch.context() as patch:
        patch.setattr("morgs_mi.render.compositing._Blend.backward", interrupt)
        assert garbage_of(interrupted) == []
    assert [first.encoded, loop.push(clip[1][:4])[0].encoded] == packets


@pytest.mark.slow
def test_push__reports_a_black_first_frame_and_a_cut(clip):
    loop = StreamLoop(cameras()[:4], *points_and_colors(), SHORT)
    black = [np.zeros_like(image) for image in clip[0][:4]]
    cut = [np.ascontiguousarray(image[::-1, ::-1, ::-1]) for image in clip[1][:4]]
    statuses = [loop.push(images)[1].status for images in (black, clip[0][:4], clip[1][:4], cut)]
    assert [status.split(";")[0] for status in statuses] == [
        "cam00, cam01, cam02, cam03: the image is black",
        "ok",
        "ok",
        "the images show another scene than in the frame before",
    ]


def test_push__reports_cameras_in_another_order(caplog):
    views = rig()
    images = [render(view, textures()) for view in views]
    order = [0, 4, 2, 3, 1, 5]
    loop = StreamLoop(views, np.zeros((0, 3)), np.zeros((0, 3)), quick())
    loop.push([images[view] for view in order])
    assert "the clips of cam1 and cam4, or their poses, seem to be swapped" in caplog.text
    loop = StreamLoop([views[view] for view in order], np.zeros((0, 3)), np.zeros((0, 3)), quick())
    named = dict(zip((view.name for view in views), images, strict=True))
    caplog.clear()
    loop.push(named, upcoming=named)
    assert "swapped" not in caplog.text
    assert loop.push(named)[1].missing_views == ()


@pytest.mark.slow
def test_push__light_above_white_is_fitted_and_followed():
    """The wall of the scene shines with 1 to 20 times white; images, points and packets have
    encoded colours.
    """

    def shining(frame):
        gaussians, moves = scene(frame)
        sh = gaussians.numpy()["sh_coeffs"] + np.where(moves, 0, 1.5 / SH_C0)[:, None, None].astype(
            np.float32
        )
        return dataclasses.replace(gaussians, sh_coeffs=sh)

    def recorded(frame):
        views = cameras()
        return [
            decode_light(np.asarray(rasterize(shining(frame), c, ("color",)).color)) for c in views
        ]

    start = shining(0).numpy()
    colors = np.maximum(start["sh_coeffs"][:, 0] * SH_C0 + 0.5, 0)
    loop = StreamLoop(cameras()[:4], start["means"], colors, SHORT)
    images = recorded(0)
    assert max(image.max() for image in images) > 10
    for frame in range(2):
        _, report = loop.push([*map(mi.TensorXf, recorded(frame)[:4])])
        assert report.status == "ok"
    assert loop.state.history.display_exposure < -1
    rendered = np.asarray(held_out(loop.gaussians, ("color",)).color)
    truth = encode_light(recorded(1)[4])
    above = truth > 1.2
    # Without the range above white the error would be at least 0.2.
    assert above.mean() > 0.2
    assert np.abs(rendered - truth)[above].mean() < 0.1
