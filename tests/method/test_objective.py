"""The objective: which terms act where, what they need rendered, and what they add up."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi.method import objective
from morgs_mi.method.flow import FlowObservation
from morgs_mi.method.flow_sources.flow_registry import FramePair
from morgs_mi.method.method_registry import Registry
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.method.objective import (
    TERMS,
    KeyView,
    ObjectiveConfig,
    Prediction,
    channels_of,
    loss_term,
    losses_of,
    observe,
    weights_of,
)
from morgs_mi.method.ssim import Target
from morgs_mi.render.rasterize import Image
from tests.scenes.derivatives import gradient
from tests.scenes.gaussians import make_scene, to_gaussians

H = 16
W = 24
NAMES = [term.name for term in TERMS]


def key_view(mask):
    image = np.zeros((H, W, 3), np.uint8)
    flow = np.ones((H, W, 2), np.float32)
    everywhere = np.ones((H, W), bool)
    return KeyView(
        FramePair(image, image),
        FlowObservation(flow, everywhere, flow, everywhere, everywhere if mask else None),
    )


@pytest.mark.parametrize(
    ("motion", "mask", "expected"),
    [
        (MotionConfig(), True, {"motion", "reliable", "mask"}),
        (MotionConfig(), False, {"motion", "reliable"}),
        (MotionConfig(learn_motion=False), True, {"mask"}),
        (MotionConfig(learn_confidence=False), True, {"motion", "reliable"}),
    ],
)
def test_observe__follows_the_modules(motion, mask, expected):
    assert observe(key_view(mask), motion, ObjectiveConfig()).keys() == expected


def test_channels_of__are_those_of_the_terms_that_act():
    everything = {"motion": 0, "reliable": 0, "mask": 0}
    assert channels_of({}, ObjectiveConfig()) == ("color",)
    assert channels_of(everything, ObjectiveConfig()) == ("color", "guided_motion", "confidence")
    assert channels_of(everything, ObjectiveConfig(flow_weight=0)) == ("color", "confidence")


def test_losses_of__every_term_acts_where_its_inputs_exist_and_has_a_gradient():
    rng = np.random.default_rng(0)

    def tensor(*shape):
        values = mi.TensorXf(rng.uniform(0.2, 0.8, shape).astype(np.float32))
        dr.enable_grad(values)
        return values

    guided = {"guided_motion": tensor(H, W, 2)}
    image = Image(color=tensor(H, W, 3), confidence=tensor(H, W, 1), others=guided)
    gaussians = to_gaussians(make_scene())
    inputs = {
        "recon": image.color,
        "flow": image["guided_motion"],
        "mask": image.confidence,
        "offset": tensor(5, 3),
    }
    assert list(inputs) == NAMES, "a new term needs an input here"
    prediction = Prediction(
        image, {"offset": inputs["offset"]}, None, 1 / (H * W), 1 / 20, 2.0, gaussians, gaussians
    )
    observations = {
        "target": Target(np.zeros((H, W, 3), np.float32)),
        "motion": mi.TensorXf(np.zeros((H, W, 2), np.float32)),
        "reliable": mi.TensorXf(np.ones((H, W), np.float32)),
        "mask": mi.TensorXf(np.zeros((H, W), np.float32)),
    }
    assert losses_of(prediction, {"target": observations["target"]}, ObjectiveConfig()).keys() == {
        "recon",
        "offset",
    }
    losses = losses_of(prediction, observations, ObjectiveConfig())
    assert list(losses) == NAMES
    for name, loss in losses.items():
        dr.backward(loss, flags=dr.ADFlag.ClearVertices)
        assert np.abs(gradient(inputs[name])).max() > 0, name
    offset = np.asarray(dr.detach(inputs["offset"]))
    assert np.asarray(losses["offset"]).item() == pytest.approx(offset.sum() / (10 * 2.0), rel=1e-5)


def test_weights_of__are_those_of_the_settings():
    config = ObjectiveConfig(flow_weight=2.0, mask_weight=3.0, offset_weight=4.0)
    assert weights_of(config) == {"recon": 1, "flow": 2, "mask": 3, "offset": 4}
    with pytest.raises(ValueError, match="`flow_weight` must be at least 0, got -1"):
        ObjectiveConfig(flow_weight=-1)


@pytest.fixture
def registry(monkeypatch):
    """Return an empty registry of terms."""
    monkeypatch.setattr(
        objective, "LOSS_TERMS", Registry("ObjectiveConfig()", "terms", objective.ObjectiveConfig)
    )
    return objective.LOSS_TERMS


def test_loss_term__acts_where_its_observation_exists(registry):
    observer = lambda view, motion, config: {"height": view.pair.image[..., 0] + 7.0}  # noqa: E731

    @loss_term("height", channels=("depth",), observations=("height",), observer=observer)
    def height_loss(prediction, observations, config):
        return dr.sum(observations["height"] - prediction.image.depth[..., 0], axis=None)

    config = ObjectiveConfig(terms=("height:2.5",))
    observations = observe(key_view(mask=False), MotionConfig(), config)
    assert observations.keys() == {"motion", "reliable", "height"}
    assert channels_of(observations, config) == ("color", "guided_motion", "depth")
    assert channels_of(observations, ObjectiveConfig()) == ("color", "guided_motion")
    assert channels_of({}, config) == ("color",)
    assert weights_of(config)["height"] == 2.5

    prediction = Prediction(
        Image(depth=mi.TensorXf(np.full((H, W, 1), 3.0))),
        {},
        None,
        1 / (H * W),
        1.0,
        1.0,
        None,
        None,
    )
    losses = losses_of(prediction, {"height": mi.TensorXf(observations["height"])}, config)
    assert losses.keys() == {"height"}
    assert np.asarray(losses["height"]).item() == 4 * H * W


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        (("fast:1",), r"ObjectiveConfig\(\): `terms` must be one of speed:WEIGHT, got 'fast:1'"),
        (("speed:-1",), r"`terms` must be a number in \[0, inf\), got -1.0"),
        (("speed:1", "speed:2"), "must name each term once"),
        ("speed:1", "`terms` must be a list"),
    ],
)
def test_objective_config__refuses_terms(registry, terms, message):
    loss_term("speed")(lambda p, o, config: 0)
    with pytest.raises(ValueError, match=message):
        ObjectiveConfig(terms=terms)


def test_objective_config__refuses_terms_where_none_is_registered(registry):
    with pytest.raises(
        ValueError, match="`terms` must be one of the registered names, of which there are none"
    ):
        ObjectiveConfig(terms=("speed:1",))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("flow", "which the objective has already"),
        ("speed", "a new name"),
    ],
)
def test_loss_term__refuses_names(registry, name, message):
    loss_term("speed")(lambda p, o, config: 0)
    with pytest.raises(ValueError, match=message):
        loss_term(name)(lambda p, o, config: 0)
