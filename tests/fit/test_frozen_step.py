"""Recorded steps: the same bits as the plain ones, nothing stored that should be an argument."""

from collections import deque
from dataclasses import replace
from unittest.mock import patch

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from morgs_mi import RenderConfig
from morgs_mi.core.arrays import from_numpy
from morgs_mi.core.gaussians import at_rest
from morgs_mi.fit import first_frame, frozen_step, later_frame
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.fit.frozen_step import RecordedSteps, room_for
from morgs_mi.fit.frozen_views import LaterSteps
from morgs_mi.fit.later_frame import FrameProblem, fit_later_frame
from morgs_mi.fit.optimise import adam
from morgs_mi.method.active_set import ActiveSet, full_active_set
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import ObjectiveConfig, recon_loss
from morgs_mi.method.observed_view import ObservedView
from morgs_mi.method.residual import residual_parameters
from morgs_mi.method.ssim import Target
from morgs_mi.method.ssim_layout import Lanes
from morgs_mi.render.kernel_recording import num_recordings
from morgs_mi.render.rasterize import rasterize
from morgs_mi.render.region import NO_SLOT, Region
from tests.scenes.ball import ball, bytes_of, images_of, opaque_ball, problem
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.views import make_active_view, observed

RENDER = RenderConfig()
MOTION = MotionConfig()
EXTENT = 3.0


def moving_ball(static_count=250, grown=0, render=RENDER):
    """Return the problem of a frame in four views of two sizes, with regions of four sizes: one of
    them a key view with a mask of its pixels.

    Args:
        static_count: number of Gaussians that are not active, of 400.
        grown: pixels by which the regions are larger.
        render: cut-offs, and the colour behind all Gaussians.
    """
    previous = at_rest(replace(opaque_ball(), logit_confidence=np.zeros(400)))
    active_rows = np.arange(static_count, 400)
    truth = replace(previous, means=np.asarray(previous.means) + 0.03)
    cameras = look_at_cameras(QUAD[:2], 40) + look_at_cameras(QUAD[2:], 40, 76, 52)
    views = {}
    for v, camera in enumerate(cameras):
        image = np.clip(np.asarray(rasterize(truth, camera, ("color",)).color), 0, 1)
        drawn = np.zeros(image.shape[:2], bool)
        drawn[5 + v : 28 + 2 * v + grown, 4 : 30 - v] = True
        channels = ("color",)
        mask = None
        observations = {}
        if v == 1:
            rng = np.random.default_rng(0)
            flow = rng.normal(size=(*drawn.shape, 2)).astype(np.float32)
            observations = {"motion": flow, "reliable": np.ones(drawn.shape, np.float32)}
            observations["mask"] = drawn.astype(np.float32)
            channels = ("color", "guided_motion", "confidence")
            mask = rng.random(drawn.shape) < 0.9
        static = previous.select(np.arange(static_count))
        view = make_active_view(camera, Region.of(drawn, render), static, channels, render)
        views[v] = ObservedView.of(view, Target(image, mask), observations)
    active = ActiveSet(active_rows, 400, views, 4)
    return FrameProblem(previous, active, views, None, EXTENT)


def raw(fitted):
    return {name: values.tobytes() for name, values in fitted.gaussians.numpy().items()}


def without_recordings(function):
    """Return the result of a function with plain steps alone."""
    with (
        patch.object(later_frame, "is_recordable", lambda *_: False),
        patch.object(first_frame, "is_recordable", lambda *_: False),
        patch.object(RecordedSteps, "step", side_effect=AssertionError),
    ):
        return function()


@pytest.mark.parametrize("background", [None, (0.1, 0.7, 0.4)])
def test_fit_later_frame__has_the_same_bits_as_by_plain_steps(background):
    """40 steps and a round of births, whose scores some of them take."""
    render = RenderConfig(background=background)
    density = DensityConfig(later_frames=True, births=0.1, min_error=0)
    config = FitConfig(sh_degree=0, epochs=10, density=density)

    def fit():
        frame = moving_ball(render=render)
        return fit_later_frame(frame, config, MOTION, np.random.default_rng(0))

    recorded = fit()
    expected = without_recordings(fit)
    assert (recorded.source < 0).sum() > 5
    assert raw(recorded) == raw(expected)
    assert_array_equal(recorded.source, expected.source)
    assert recorded.losses == pytest.approx(expected.losses, rel=1e-5)
    assert recorded.psnr == pytest.approx(expected.psnr, rel=1e-5)


def test_fit_later_frame__records_no_step_anew_after_three_frames(monkeypatch):
    """Twelve frames with births and a growing active set; views are drawn in another order each."""
    density = DensityConfig(later_frames=True, births=0.02, min_error=0)
    config = FitConfig(sh_degree=0, epochs=5, density=density)
    settings = set()
    recorded = frozen_step.recorded

    def noted(function, setting):
        settings.add(setting)
        return recorded(function, setting)

    monkeypatch.setattr(frozen_step, "recorded", noted)
    # As in a new process.
    monkeypatch.setattr(frozen_step, "sizes_by_name", {})
    monkeypatch.setattr(frozen_step, "entries_per_splat", deque([8.0], maxlen=4))
    counts = []
    for frame in range(12):
        rng = np.random.default_rng(frame)
        fitted = fit_later_frame(moving_ball(250 - 2 * frame, frame % 5), config, MOTION, rng)
        assert (fitted.source < 0).sum() > 5
        scored = sum(setting.is_scored for setting in settings)
        counts.append((len(settings) - scored, scored, num_recordings()))
    steps, scored_steps, all_recordings = np.transpose(counts)
    assert (steps[2:] == steps[2]).all()
    # Steps with scores have a recording for each kind of view, when such a view is drawn.
    assert scored_steps[-1] <= steps[-1]
    assert all_recordings[-1] - all_recordings[2] <= 2


def test_fit_later_frame__has_the_same_bits_if_all_gaussians_are_active():
    truth = opaque_ball()
    images = images_of(replace(truth, means=np.asarray(truth.means) + 0.02))
    views = dict(enumerate(look_at_cameras(QUAD, 40)))
    config = FitConfig(sh_degree=0, epochs=5)

    def fit():
        active = full_active_set(truth, views, RENDER)
        motion = MotionConfig(learn_confidence=False)
        frame = FrameProblem(truth, active, observed(active.views, images), None, EXTENT)
        return fit_later_frame(frame, config, motion, np.random.default_rng(0))

    assert raw(fit()) == raw(without_recordings(fit))


@pytest.mark.parametrize(
    ("dropout", "background"), [(0.0, None), (0.3, None), (0.0, (0.1, 0.7, 0.4))]
)
def test_fit_first_frame__has_the_same_bits_as_by_plain_steps(dropout, background):
    """A band, rounds of density control, and a masked view."""
    images = bytes_of(images_of(opaque_ball()))
    masks = [None, np.indices(images[1].shape[:2])[0] > 4, None, None]
    density = DensityConfig(rounds=2)
    config = FitConfig(
        sh_degree=1, num_gaussians=100, first_frame_steps=90, density=density, dropout=dropout
    )

    def fit():
        render = RenderConfig(background=background)
        frame = problem(images, ball(80, sh_degree=1), masks, render)
        return first_frame.fit_first_frame(frame, config, np.random.default_rng(0))

    assert raw(fit()) == raw(without_recordings(fit))


@pytest.mark.parametrize("entries_per_splat", [0.05, 8.0])
def test_recorded_steps__are_made_again_by_plain_ones_if_lists_were_too_short(
    entries_per_splat, monkeypatch
):
    monkeypatch.setattr(frozen_step, "entries_per_splat", deque([entries_per_splat], maxlen=4))
    monkeypatch.setattr(frozen_step, "sizes_by_name", {"entries of 768": [64]})
    lengths = []
    finish = RecordedSteps.finish

    def counted(steps, optimizer):
        losses = finish(steps, optimizer)
        lengths.append(losses is None)
        return losses

    monkeypatch.setattr(RecordedSteps, "finish", counted)
    config = FitConfig(sh_degree=0, epochs=4)

    def fit():
        return fit_later_frame(moving_ball(), config, MOTION, np.random.default_rng(0))

    assert raw(fit()) == raw(without_recordings(fit))
    assert lengths[0] == (entries_per_splat < 1)
    assert not lengths[-1]  # the first ones have counted the entries


def test_room_for__keeps_a_size_while_numbers_vary_by_a_quarter(monkeypatch):
    monkeypatch.setattr(frozen_step, "sizes_by_name", {})
    size = room_for("splats", 1000)
    assert size >= 1250
    assert {room_for("splats", number) for number in (800, 1000, 1250, 900)} == {size}
    large = room_for("splats", 3000)
    assert large >= 3750
    assert room_for("splats", 1000) == size  # that is known already
    assert room_for("splats", 3100) == large
    assert room_for("others", 5) > 0


def changed(name, values):
    """Return another value of an argument, with which no place outside of the arrays is read."""
    others = {
        "tile": lambda: values + 1,  # which lists nothing
        "slot_of": lambda: np.where(values == NO_SLOT, values, values + 1),
        "tile_table": lambda: values[::-1],
        "place": lambda: np.roll(values, 1),
        "left": lambda: values[::-1],
        "middle": lambda: values[::-1],
        "right": lambda: values[::-1],
        "rows": lambda: values // 2,
        "pitch": lambda: 0 * values,
        "first": lambda: values + 2,
        "end": lambda: values - 2,
        "height": lambda: values // 4,
        "radius": lambda: 0 * values,
    }
    if name in others:
        return others[name]()
    if values.dtype == bool:
        return np.zeros_like(values)
    if values.dtype.kind == "f":
        return values * 1.1 + 0.1
    return np.maximum(values, 1) - 1


def leaves(tree, path=()):
    """Yield (path, array) of a tree of arrays."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from leaves(value, (*path, name))
    elif isinstance(tree, list | tuple) or dr.depth_v(tree) > 1:
        for k, value in enumerate(tree):
            yield from leaves(value, (*path, k))
    else:
        yield path, tree


def with_leaf(tree, path, value):
    """Return a tree with one array replaced."""
    if not path:
        return value
    if isinstance(tree, dict):
        return {**tree, path[0]: with_leaf(tree[path[0]], path[1:], value)}
    copy = list(tree)
    copy[path[0]] = with_leaf(copy[path[0]], path[1:], value)
    return type(tree)(copy)


def test_later_steps__have_arrays_of_the_sizes_that_their_settings_give(monkeypatch):
    """Dr.Jit infers the sizes of launches from those of arrays: a recording whose 832 lanes were
    eight times as many as the static splats had 432 lanes with 54 of them, and wrote elsewhere.
    """
    monkeypatch.setattr(frozen_step, "sizes_by_name", {})
    sizes = {}
    for static_count in (250, 240, 220):
        frame = moving_ball(static_count)
        optimizer = adam(residual_parameters(frame.gaussians, MOTION))
        steps = LaterSteps(frame.views, optimizer, ObjectiveConfig(), MOTION)
        for view in steps._views.values():
            widths = [(path, dr.width(values)) for path, values in leaves(view.arrays)]
            assert sizes.setdefault((view.losses, view.sizes), widths) == widths
    assert len(sizes) == 3  # of four views, two have the same setting


def recorded_arguments(view, is_scored):
    """Return the setting and the arguments of the second step of a view."""
    frame = moving_ball()
    previous = frame.active.select(frame.previous)
    optimizer = adam(residual_parameters(previous, MOTION))
    objective = ObjectiveConfig()
    steps = LaterSteps(frame.views, optimizer, objective, MOTION)
    steps = steps.of(previous, 400, EXTENT)
    calls = []
    recorded = frozen_step.recorded

    def noted(function, setting):
        def call(*arguments):
            calls.append((setting, arguments))
            return recorded(function, setting)(*arguments)

        return call

    with patch.object(frozen_step, "recorded", noted):
        for _ in range(2):
            steps.step(optimizer, view, dict.fromkeys(optimizer, 1e-3), is_scored)
    return calls[1]


@pytest.mark.parametrize(("view", "is_scored"), [(0, False), (1, False), (1, True)])
def test_frozen_step__depends_on_each_of_its_arguments(view, is_scored):
    """One that a recording had stored would change nothing."""
    setting, arguments = recorded_arguments(view, is_scored)
    names = ("state", "numbers", "view", "shared")
    step = frozen_step.recorded(frozen_step.frozen_step, setting)

    def result(tree):
        state = step(*(tree[name] for name in names))
        return [np.array(values).tobytes() for _, values in leaves(state)]

    tree = dict(zip(names, arguments, strict=True))
    first_count = num_recordings()
    expected = result(tree)
    silent = []
    for path, values in leaves(tree):
        host = np.array(values)
        if path == ("view", "words"):
            for name, dtype, first, size in setting.losses.packing.places:
                other = host.copy()
                part = other[first : first + size].view(dtype)
                part[:] = changed(name.rpartition(" ")[2], part)
                if result(with_leaf(tree, path, from_numpy(mi.UInt32, other))) == expected:
                    silent.append(name)
            continue
        name = next(key for key in reversed(path) if isinstance(key, str))
        if result(with_leaf(tree, path, from_numpy(type(values), changed(name, host)))) == expected:
            silent.append(path)
    assert result(tree) == expected
    assert num_recordings() <= first_count + 1
    # The confidence of the residual takes the place of the previous one. The copy around the region
    # has no neighbours, and what it lacks still has the target's pixels by chance, see below.
    without_effect = {("shared", "previous", "logit_confidence")}
    without_effect |= {name for name in silent if "around" in name}
    assert set(silent) == without_effect


def test_comparison__copies_all_pixels_that_windows_read(monkeypatch):
    rng = np.random.default_rng(0)
    shape = (70, 150, 3)
    target = Target(rng.random(shape).astype(np.float32))
    drawn = np.zeros(shape[:2], bool)
    drawn[20:30, 3:11] = drawn[66:, 130:] = True
    region = Region.of(drawn, RENDER)
    image = mi.TensorXf(rng.random(region.shape(3)).astype(np.float32))

    def loss():
        dr.enable_grad(image)
        loss = recon_loss(image, target, 0.2, region)
        dr.backward(loss)
        result = np.array(loss), np.array(dr.grad(image))
        dr.clear_grad(image)
        return result

    expected = loss()
    on = target.comparison(region)
    on.surroundings = None
    on.around = Lanes.of(on.runs["around"])
    monkeypatch.setattr(dr, "empty", lambda kind, size: dr.full(kind, np.nan, size) + 0)
    for value, other in zip(loss(), expected, strict=True):
        assert_array_equal(value, other)
