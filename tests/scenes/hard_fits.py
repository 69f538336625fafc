"""Recordings and settings that are hard: noise for hundreds of frames, exposures that differ by
1000, light of 1e5, images of one pixel, too few cameras, nothing to see, and rates that diverge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from morgs_mi import Camera, rasterize
from morgs_mi.core.color_space import decode_light, encode_light
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.fit.fit_config import LearningRates
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.motion_config import MotionConfig
from morgs_mi.stream_loop import StreamLoop
from tests.quick import NO_DENSITY, quick
from tests.scenes.cameras import QUAD, look_at_cameras
from tests.scenes.gaussians import isotropic

CONFIG = quick(
    MotionConfig(key_views=1),
    num_gaussians=200,
    first_frame_steps=100,
    dropout=0.0,
    density=NO_DENSITY,
)
RIG = tuple(look_at_cameras(QUAD, 50, 48, 36))
Images = Sequence[np.ndarray]


@dataclass(frozen=True)
class HardFit:
    """A recording, and the number of frames that the report fits.

    Attributes:
        name: of the recording.
        cameras: the rig.
        recorded: function from the true images [H, W, 3] in [0, 1] to those of frame t.
        num_frames: of the recording.
        psnr: which the first and the last frame exceed in the first view, dB.
        textured: whether the scene has a texture.
        config: settings of the fit.
        shift: from the scene to the points that the fit starts from.
        status: words of the status of a frame, or "ok".
    """

    name: str
    cameras: tuple[Camera, ...]
    recorded: Callable[[Images, int], Images]
    num_frames: int = 4
    psnr: float = 20.0
    textured: bool = True
    config: StreamConfig = CONFIG
    shift: tuple[float, ...] = (0.0, 0.0, 0.0)
    status: str = "ok"


def scene(textured):
    """Return a dense ball of small Gaussians of random colours, or of one grey."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = 1.4 * direction * np.cbrt(rng.uniform(size=(200, 1)))
    colors = rng.uniform(-1.4, 1.4, (200, 1, 3)) if textured else np.zeros((200, 1, 3))
    return isotropic(means, 0.25, 0.9, colors)


def eight_bits(images, noise=0.0, frame=0):
    rng = np.random.default_rng(frame)
    noisy = (image + noise * rng.normal(size=image.shape) for image in images)
    return [np.uint8(np.clip(image, 0, 1) * 255 + 0.5) for image in noisy]


def bracketed(images, frame):
    """Return 8-bit images whose exposures span a factor of 1000."""
    factors = np.geomspace(1000**-0.5, 1000**0.5, len(images))
    lights = (decode_light(image) * f for image, f in zip(images, factors, strict=True))
    return eight_bits([encode_light(light) for light in lights])


def noise(images, frame):
    rng = np.random.default_rng(frame)
    return [rng.integers(0, 256, image.shape, np.uint8) for image in images]


def rig_of(width, height):
    return tuple(look_at_cameras(QUAD, 50, width, height))


def plain(images, frame):
    """Return the true images, the same in all frames."""
    return eight_bits(images)


def with_a_black_frame(images, frame):
    return eight_bits([image * (frame != 2) for image in images])


def blinding(images, frame):
    """Return images of linear light up to 1e5."""
    return [np.float32(1e5 * decode_light(image)) for image in images]


FEW = replace(CONFIG, fit=replace(CONFIG.fit, num_gaussians=20))
LONG = replace(CONFIG, fit=replace(CONFIG.fit, first_frame_steps=2000))
_RATES = {name: 100 * rate for name, rate in asdict(CONFIG.fit.first_frame_rates).items()}
DIVERGING = replace(CONFIG, fit=replace(CONFIG.fit, first_frame_rates=LearningRates(**_RATES)))
HARD_FITS = [
    HardFit("still, noise of 0.03", RIG, lambda images, t: eight_bits(images, 0.03, t), 300),
    HardFit("120 still frames", RIG, plain, 120),
    HardFit("a black frame in mid-stream", RIG, with_a_black_frame, 5, psnr=5.0, status="black"),
    HardFit("noise alone", RIG, noise, psnr=0.0, status="another scene"),
    HardFit("exposures 1:1000", RIG, bracketed, psnr=10.0, status="worse than constant"),
    HardFit("light up to 1e5", RIG, blinding, psnr=0.0),
    HardFit("one camera", RIG[:1], plain),
    HardFit(
        "two equal cameras",
        (RIG[0], replace(RIG[0], name="again")),
        plain,
    ),
    HardFit("no texture", RIG, plain, textured=False),
    HardFit(
        "black",
        RIG,
        lambda images, t: [np.zeros((36, 48, 3), np.uint8) for _ in images],
        status="black",
    ),
    HardFit("images of 1x1", rig_of(1, 1), plain, psnr=5.0, config=FEW, status="of one colour"),
    HardFit("2,000 steps on 8x6", rig_of(8, 6), plain, config=LONG),
    HardFit(
        "points that no camera sees",
        RIG,
        plain,
        shift=(0.0, 500.0, 0.0),
        psnr=0.0,
        status="the cameras see 0 %",
    ),
    HardFit("rates x 100", RIG, plain, psnr=0.0, config=DIVERGING, status="worse than constant"),
]


def fitted(fit):
    """Yield the PSNR of the first view against the truth, the raw attributes and the status of each
    frame.
    """
    truth = scene(fit.textured)
    images = [
        np.clip(np.asarray(rasterize(truth, camera, ("color",)).color), 0, 1)
        for camera in fit.cameras
    ]
    if fit.name == "black":
        images = [0 * image for image in images]
    raw = truth.numpy()
    points = raw["means"] + np.float32(fit.shift)
    loop = StreamLoop(fit.cameras, points, np.full((200, 3), 0.5), fit.config)
    for frame in range(fit.num_frames):
        _, report = loop.push(fit.recorded(images, frame))
        color = np.asarray(rasterize(loop.gaussians, fit.cameras[0], ("color",)).color)
        quality = psnr(np.clip(color, 0, 1), images[0])
        yield quality, loop.gaussians.numpy(), report.status
