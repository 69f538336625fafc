"""Settings of the optimisation."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Lt

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.method.objective import ObjectiveConfig
from morgs_mi.platform.config import Count, NonNegative, NonNegativeInt, Positive, config_class

# Epochs of a later frame before the learning rate of the means begins to decay.
_CONSTANT_EPOCHS = 2
# Epochs of a later frame that its learning rates were chosen for: they are larger in fewer epochs.
_USUAL_EPOCHS = 8
MOST_GAUSSIANS = 250_000
"""Largest number of Gaussians of a first frame whose number is not given, for memory, the time of
later frames and the size of the stream.
"""
# Least number of steps of a first frame.
_LEAST_STEPS = 1200
# Gaussians of a first frame per step: many see each pixel less often.
_GAUSSIANS_PER_STEP = 25


@config_class
class LearningRates:
    """Adam's learning rate of every parameter, per step.

    The defaults are for a later frame. They were chosen on the clip `spheres`, held-out view, from
    1x to 8x the rates of 3DGS (Kerbl et al. 2023): 3DGS takes thousands of steps where a frame here
    has under a hundred.
    """

    means: NonNegative = 5e-4
    """Learning rate of the means, motion and offset, in scene extents."""
    scales: NonNegative = 1e-2
    """Learning rate of the logarithms of the scales."""
    quats: NonNegative = 1e-2
    """Learning rate of the rotations."""
    opacities: NonNegative = 0.05
    """Learning rate of the logits of the opacities."""
    sh_dc: NonNegative = 1e-2
    """Learning rate of the constant SH coefficient."""
    sh_rest: NonNegative = 5e-4
    """Learning rate of the other SH coefficients: a twentieth of the constant one's, as in 3DGS."""
    confidence: NonNegative = 0.05
    """Learning rate of the logits of the confidence."""

    def by_parameter(self, extent: float) -> dict[str, float]:
        """Return the learning rate of every parameter of the attribute table by its name; `extent`
        in world units.
        """
        return {
            a.name: (getattr(self, a.rate) if isinstance(a.rate, str) else a.rate)
            * (extent if a.rate_in_extents else 1)
            for a in ATTRIBUTES
            if a.rate is not None
        }


@config_class
class DensityConfig:
    """Settings of density control (see `density`), with thresholds from the literature."""

    rounds: NonNegativeInt = 6
    """Rounds of density control in the first frame; 0: none. With them, the first frame starts from
    half of its Gaussians and grows to all."""
    later_frames: bool = True
    """One round of density control in every later frame."""
    births: NonNegative = 0.02
    """Largest number of births in a later frame, as a fraction of the Gaussians."""
    max_gaussians: Count = 60_000
    """Number of Gaussians beyond which a later frame adds none unless others are pruned."""
    split_scale: NonNegative = 0.01
    """Scale, in scene extents, above which the first frame splits a Gaussian instead of cloning it.
    """
    min_error: NonNegative = 0.1
    """Attributed error, in pixels of full contrast, below which a later frame does not densify a
    Gaussian.
    """
    min_opacity: Annotated[float, Gt(0), Lt(1)] = 0.005
    """Opacity below which a Gaussian is pruned."""


@config_class
class CameraPriors:
    """Standard deviations of the errors of a calibration, under which its cameras are refined."""

    rotation: Positive = 0.5
    """Rotation about each axis, degrees."""
    position: Positive = 0.005
    """Position along each axis, in scene extents."""
    focal: Positive = 0.01
    """Focal lengths, relative."""
    distortion: Positive = 0.1
    """First term of radial distortion that the calibrated lens leaves; the second has a fifth of
    this deviation.
    """


@config_class
class ShortFitConfig:
    """Settings of the short fits that compare refined cameras with calibrated ones, and estimate
    exposures.
    """

    gaussians: Annotated[int, Ge(4)] = 4000
    """Number of Gaussians."""
    steps: Annotated[int, Ge(2)] = 300
    """Steps of a fit; each further round takes half as many."""
    rounds: Count = 5
    """Rounds of fitting Gaussians and changing the exposures."""
    width: Count = 320
    """Least width to which images are reduced, px."""


@config_class
class FitConfig:
    """Settings of the optimisation."""

    sh_degree: Annotated[int, Ge(0), Le(3)] = 1
    """Degree of the spherical harmonics, 0 to 3; 0 is enough where no surface is glossy."""
    num_gaussians: Count | None = None
    """Number of Gaussians of the first frame; None: from the detail of its images and its time (see
    `budget`). It starts from `first_count`."""
    first_frame_steps: Count | None = None
    """Steps of the first frame, one view each; None: from its Gaussians and its time (see
    `budget`).
    """
    first_frame_seconds: Positive | None = None
    """Time that the first frame may take, with the exposures: a limit of this machine's clock, for
    which steps are skipped. It also limits those numbers of Gaussians and of steps that are not
    given. None: they take 120 s on two cores of a server, and are the same on every machine."""
    dropout: Annotated[float, Ge(0), Lt(1)] | None = None
    """Probability with which each step of the first frame leaves a Gaussian out (see `dropped`);
    None: from the noise of the images and the angles between the views."""
    noise_aware: bool = True
    """Fit the first frame to noisy images by L1 alone: SSIM makes the fit follow their noise."""
    refine_cameras: Literal["off", "auto", "on"] = "off"
    """Refine poses and intrinsics on the first frame: off, auto (taken if withheld pixels show that
    they are better) or on (always taken)."""
    camera_priors: CameraPriors = CameraPriors()
    """Errors that the calibration may have."""
    exposure: Literal["off", "auto", "on"] = "auto"
    """Estimate gain and bias of each camera and frame: off, auto (differences between the cameras
    are taken if withheld pixels show that they are real) or on (always taken)."""
    short_fits: ShortFitConfig = ShortFitConfig()
    """Fits that compare refined cameras, and estimate exposures."""
    confidence_steps: NonNegativeInt = 40
    """Steps that learn the confidence of the first frame from the masks of its key views."""
    epochs: Count = 8
    """Passes over all training views for every later frame; the paper's small variant takes 5."""
    skip_static: bool = True
    """Skip the Gaussians, blocks of pixels and views that cannot have changed (see `active_set`).
    """
    objective: ObjectiveConfig = ObjectiveConfig()
    """Weights of the losses."""
    density: DensityConfig = DensityConfig()
    """Density control."""
    rates: LearningRates = LearningRates()
    """Learning rates of every later frame, which `rates_at` adapts to the epoch."""
    decay_means_rate: bool = True
    """Let the learning rate of the means decay within a later frame."""
    first_frame_rates: LearningRates = LearningRates(
        means=2e-3, scales=0.02, quats=0.02, opacities=0.2, confidence=0.2
    )
    """Learning rates at the start of the first frame. The confidence is fitted alone, at a constant
    rate.
    """

    def rates_at(self, epoch: int) -> LearningRates:
        """Return the learning rates of an epoch of a later frame, counted from 0.

        The rate of the means is constant in the first two epochs and then falls like 1 / (epoch +
        1): a mean that has nearly arrived does not leave again. All others are larger by (8 /
        epochs)^1/2: fewer steps have to go as far.
        """
        means = min(1.0, _CONSTANT_EPOCHS / (epoch + 1)) if self.decay_means_rate else 1.0
        others = (_USUAL_EPOCHS / self.epochs) ** 0.5
        rates = {
            n: (means if n == "means" else others) * rate for n, rate in asdict(self.rates).items()
        }
        return LearningRates(**rates)

    @property
    def momentum(self) -> float:
        """Adam's momentum in a later frame: 0.9 in 8 epochs, and gradients fade in the same share
        of fewer steps.
        """
        return 0.9 ** max(_USUAL_EPOCHS / self.epochs, 1)

    @property
    def planned_steps(self) -> int:
        """Number of steps of the first frame: where none is given, one per 25 Gaussians, at least
        1200.
        """
        if self.first_frame_steps is not None:
            return self.first_frame_steps
        return max(_LEAST_STEPS, round(self.planned_gaussians / _GAUSSIANS_PER_STEP))

    @property
    def planned_gaussians(self) -> int:
        """Largest number of Gaussians of the first frame."""
        return MOST_GAUSSIANS if self.num_gaussians is None else self.num_gaussians

    @property
    def first_count(self) -> int:
        """Number of Gaussians that the first frame starts from."""
        return -(-self.planned_gaussians // 2) if self.density.rounds else self.planned_gaussians
