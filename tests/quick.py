"""The quick configuration of tests that fit a stream; a test changes what it is about.

It fits 80 Gaussians in eight steps and one epoch per later frame, without density control: enough
for a test that asks what a fit writes, and not for one that asks how good it is.
"""

from dataclasses import replace

from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.fit.fit_config import DensityConfig, FitConfig
from morgs_mi.loop.stream_config import StreamConfig
from morgs_mi.method.motion_config import MotionConfig

NO_DENSITY = DensityConfig(rounds=0, later_frames=False)
FIT = FitConfig(
    sh_degree=0,
    num_gaussians=80,
    first_frame_steps=8,
    confidence_steps=4,
    epochs=1,
    density=DensityConfig(rounds=0),
)
MOTION = MotionConfig(key_views=1)
# The same for the command line, as far as it has options.
OPTIONS = ["--num-gaussians", "80", "--first-frame-steps", "8", "--epochs", "1", "--sh-degree", "0"]
# A settings file with short fits for the refinement of cameras and for exposures.
SHORT_FITS = "[fit.short_fits]\ngaussians = 400\nsteps = 30\nrounds = 1\n"


def quick(motion=MOTION, codec=None, **fit):
    """Return the quick configuration with some changes.

    Args:
        motion: another configuration of the motion.
        codec: another one of the codec.
        **fit: changed fields of `FitConfig`.
    """
    return StreamConfig(replace(FIT, **fit), motion, codec=codec or CodecConfig())
