"""Settings: presets and rates."""

from dataclasses import asdict

import pytest

from morgs_mi.fit.fit_config import FitConfig, LearningRates
from morgs_mi.loop.stream_config import PRESETS, StreamConfig, apply_preset
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.render.render_config import RenderConfig


@pytest.mark.parametrize(
    ("name", "epochs", "modules", "lifted"),
    [
        ("l", 8, (True, True, True), True),
        ("s", 5, (True, True, True), True),
        ("baseline", 8, (False, False, False), True),
        ("ml", 8, (True, False, False), True),
        ("ml-mo", 8, (True, True, False), True),
        ("ml-mo-mc", 8, (True, True, True), True),
        ("paper", 8, (True, True, True), False),
    ],
)
def test_apply_preset__gives_the_rows_of_the_paper(name, epochs, modules, lifted):
    base = StreamConfig(fit=FitConfig(num_gaussians=77), motion=MotionConfig(key_views=12), seed=3)
    config = apply_preset(base, name)
    fit = config.fit
    motion = config.motion
    assert fit == FitConfig(num_gaussians=77, epochs=epochs, decay_means_rate=lifted)
    assert (motion.learn_motion, motion.learn_offset, motion.learn_confidence) == modules
    assert (motion.lift_flow, motion.propagate_motion, motion.key_views) == (lifted, lifted, 12)
    assert (motion.refine_start, motion.search_motion) == (lifted, lifted)
    assert (motion.lift_confidence, motion.two_gates) == (lifted, lifted)
    assert config.render == RenderConfig(first_order_motion=not lifted)
    assert (config.codec, config.seed) == (base.codec, 3)


def test_apply_preset__rejects_an_unknown_name():
    with pytest.raises(ValueError, match=f"must be one of {', '.join(PRESETS)}, got 'xl'"):
        apply_preset(StreamConfig(), "xl")  # type: ignore[arg-type]


def test_momentum__fades_in_the_same_share_of_fewer_epochs():
    assert FitConfig(epochs=8).momentum == 0.9
    assert FitConfig(epochs=2).momentum == pytest.approx(0.9**4)


def test_rates_at__decays_the_rate_of_the_means_and_raises_the_others_for_fewer_epochs():
    means = [FitConfig(epochs=8).rates_at(k).means / LearningRates().means for k in range(8)]
    assert means == pytest.approx([1, 1, 2 / 3, 1 / 2, 2 / 5, 1 / 3, 2 / 7, 1 / 4])
    assert all(FitConfig(decay_means_rate=False).rates_at(k) == LearningRates() for k in range(8))
    for epochs, factor in ((8, 1), (2, 2)):
        for k in range(epochs):
            rates = asdict(FitConfig(epochs=epochs).rates_at(k))
            for name in rates.keys() - {"means"}:
                assert rates[name] == factor * getattr(LearningRates(), name)
