"""Settings of the optimisation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from itertools import pairwise
from math import inf
from typing import Literal

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.method.exposure import ExposureConfig
from morgs_mi.method.objective import ObjectiveConfig

__all__ = [
    "CameraPriors",
    "ConvergenceConfig",
    "CrossValidationConfig",
    "DensityConfig",
    "DetailConfig",
    "FitConfig",
    "LearningRates",
    "RefinementConfig",
]


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate of every parameter, per step.

    The defaults are those of a later frame. They were chosen on the clip `spheres`, held-out view, from 1x to
    8x the rates of 3DGS (Kerbl et al. 2023): 3DGS takes thousands of steps where a frame here has under a hundred.
    """

    means: float = 5e-4
    """Learning rate of the means, motion and offset, in scene extents."""
    scales: float = 1e-2
    """Learning rate of the logarithms of the scales."""
    quats: float = 1e-2
    """Learning rate of the rotations."""
    opacities: float = 0.05
    """Learning rate of the logits of the opacities."""
    sh_dc: float = 1e-2
    """Learning rate of the constant SH coefficient."""
    sh_rest: float = 5e-4
    """Learning rate of the other SH coefficients: a twentieth of the constant one's, as in 3DGS."""
    confidence: float = 0.05
    """Learning rate of the logits of the confidence."""

    def __post_init__(self) -> None:
        for name, rate in asdict(self).items():
            if not 0 <= rate < inf:
                raise ValueError(f"LearningRates(): `{name}` must be finite and not negative, got {rate}.")

    def by_parameter(self, extent: float) -> dict[str, float]:
        """Return the learning rate of every parameter of the attribute table by its name; `extent` in world units."""
        rates = {}
        for attribute in ATTRIBUTES:
            if attribute.rate is not None:
                rate = getattr(self, attribute.rate) if isinstance(attribute.rate, str) else attribute.rate
                rates[attribute.name] = rate * extent if attribute.rate_in_extents else rate
        return rates


@dataclass(frozen=True)
class DensityConfig:
    """Settings of density control (see `density`); thresholds are those of the literature."""

    rounds: int = 6
    """Rounds of density control in the first frame; 0: none. With them, the first frame starts from half of its
    Gaussians and grows to all."""
    first_round: float = 0.1
    """First of these rounds, as a fraction of the first frame's steps."""
    last_round: float = 0.5
    """Last of them, likewise: the rest of the steps fits what was added."""
    later_frames: bool = True
    """One round of density control in every later frame."""
    later_round: float = 0.625
    """That round, as a fraction of the frame's epochs: the residual has shown by then what is missing, and enough steps
    are left to fit what is added."""
    later_views: int = 8
    """Views, spread over the rig, in which a later frame looks for what is missing."""
    births: float = 0.02
    """Largest number of births in a later frame, as a fraction of the Gaussians."""
    max_gaussians: int = 60_000
    """Number of Gaussians beyond which a later frame adds none unless others are pruned."""
    birth_opacity: float = 0.1
    """Opacity of a Gaussian that is added in a later frame."""
    split_scale: float = 0.01
    """Scale, in scene extents, above which the first frame splits a Gaussian instead of cloning it."""
    shrink: float = 1.6
    """Factor by which a split Gaussian, and one that is added in a later frame, is smaller than its parent."""
    min_error: float = 0.1
    """Attributed error, in pixels of full contrast, below which a later frame does not densify a Gaussian."""
    noise_tolerance: float = 3.0
    """Error that counts as noise in a later frame, in medians of the image's error: normal noise, independent in three
    colours, exceeds 3 at 3 of 10,000 pixels."""
    min_opacity: float = 0.005
    """Opacity below which a Gaussian is pruned."""

    def __post_init__(self) -> None:
        for name, low in (
            ("rounds", 0),
            ("births", 0),
            ("max_gaussians", 1),
            ("later_views", 1),
            ("split_scale", 0),
            ("min_error", 0),
        ):
            if not getattr(self, name) >= low:
                raise ValueError(f"DensityConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")
        for name in ("birth_opacity", "min_opacity"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"DensityConfig(): `{name}` must lie between 0 and 1, got {getattr(self, name)}.")
        for name in ("first_round", "last_round", "later_round"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"DensityConfig(): `{name}` must be 0 to 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class CrossValidationConfig:
    """Settings of the cross-validation of the first frame (see `cross_validation`)."""

    candidates: tuple[float, ...] = (0.0, 0.2, 0.4)
    """Probabilities of dropping, in rising order."""
    share: int = 6
    """One view of that many is withheld, at least one."""
    min_views: int = 6
    """Number of views below which nothing is withheld, as a rig that lacks one of fewer is too different: two fits are
    compared to estimate other views (see `agreement`)."""
    width: int = 640
    """Images are reduced by the largest whole factor that leaves this width, in px."""
    steps: float = 0.4
    """Steps of each fit, as a fraction of the first frame's."""

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in pairwise(self.candidates))
        if not self.candidates or not rising or not 0 <= self.candidates[0] <= self.candidates[-1] < 1:
            raise ValueError(
                "CrossValidationConfig(): `candidates` must be rising numbers from 0 to less than 1, got "
                f"{self.candidates}."
            )
        for name, low in (("share", 2), ("min_views", 2), ("width", 1)):
            if not getattr(self, name) >= low:
                raise ValueError(
                    f"CrossValidationConfig(): `{name}` must be at least {low}, got {getattr(self, name)}."
                )
        if not 0 < self.steps <= 1:
            raise ValueError(f"CrossValidationConfig(): `steps` must be above 0 and at most 1, got {self.steps}.")


@dataclass(frozen=True)
class DetailConfig:
    """Settings of the number of Gaussians of the first frame where none is given (see `detail`)."""

    threshold: float = 0.02
    """Difference from the mean of a block, relative to white, from which a value is a detail."""
    noise_tolerance: float = 3.5
    """The same in standard deviations of the noise."""
    per_detail: float = 1.5
    """Gaussians per detail that the views do not share."""
    least_gaussians: int = 4_000
    """Least number of Gaussians."""
    most_gaussians: int = 40_000
    """Largest number of Gaussians, for the time of all frames and the size of the stream."""

    def __post_init__(self) -> None:
        for name in ("threshold", "noise_tolerance", "per_detail"):
            if not 0 < getattr(self, name) < inf:
                raise ValueError(f"DetailConfig(): `{name}` must be positive, got {getattr(self, name)}.")
        if not 1 <= self.least_gaussians <= self.most_gaussians:
            raise ValueError(
                f"DetailConfig(): `least_gaussians` must be 1 to `most_gaussians` = {self.most_gaussians}, got "
                f"{self.least_gaussians}."
            )


@dataclass(frozen=True)
class ConvergenceConfig:
    """Settings of the number of steps of the first frame where none is given (see `first_frame`)."""

    steps: int = 1500
    """Steps that every first frame gets."""
    most_steps: int = 6000
    """Largest number of steps."""
    least_decrease: float = 0.15
    """Relative decrease of L_recon over the last third of the steps from which they are doubled. Captures that are
    fitted, with noise or without it, decrease by 0.02 to 0.12 then; one with much more detail by 0.3."""

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= self.most_steps:
            raise ValueError(
                f"ConvergenceConfig(): `steps` must be 1 to `most_steps` = {self.most_steps}, got {self.steps}."
            )
        if not 0 < self.least_decrease <= 1:
            raise ValueError(
                f"ConvergenceConfig(): `least_decrease` must be above 0 and at most 1, got {self.least_decrease}."
            )


@dataclass(frozen=True)
class CameraPriors:
    """Standard deviations of the errors of a calibration, under which its cameras are refined."""

    rotation: float = 0.5
    """Of the rotation about each axis, degrees."""
    position: float = 0.005
    """Of the position along each axis, in scene extents."""
    focal: float = 0.01
    """Of the focal lengths, relative."""
    principal_point: float = 2e-4
    """Of the principal point along each axis, in image widths. Images hardly tell its displacement from a rotation, so
    it follows the calibration closely."""
    distortion: float = 0.1
    """Of the first term of radial distortion that the calibrated lens leaves; that of the second is a fifth of it."""

    def __post_init__(self) -> None:
        for name, deviation in asdict(self).items():
            if not 0 < deviation < inf:
                raise ValueError(f"CameraPriors(): `{name}` must be positive, got {deviation}.")


@dataclass(frozen=True)
class RefinementConfig:
    """Settings of the refinement of the cameras (see `calibration.refine`)."""

    priors: CameraPriors = field(default_factory=CameraPriors)
    """Errors that the calibration may have."""
    gaussians: int = 4000
    """Gaussians of the fits with which cameras are refined and judged."""
    steps: int = 300
    """Steps of such a fit; each further round takes half as many."""
    rounds: int = 5
    """Rounds of fitting Gaussians and refining cameras."""
    width: int = 320
    """Least width to which images are reduced, px."""
    least_gain: float = 0.1
    """Increase of the PSNR of withheld pixels from which refined cameras are taken, dB: less is chance."""

    def __post_init__(self) -> None:
        for name, low in (("gaussians", 4), ("steps", 2), ("rounds", 1), ("width", 1), ("least_gain", 0)):
            if not low <= getattr(self, name) < inf:
                raise ValueError(f"RefinementConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")


@dataclass(frozen=True)
class FitConfig:
    """Settings of the optimisation."""

    sh_degree: int = 1
    """Degree of the spherical harmonics, 0 to 3; 0 is enough where no surface is glossy."""
    num_gaussians: int | None = None
    """Number of Gaussians of the first frame; None: from the detail of its images (see `detail`). It starts from
    `first_count`."""
    detail: DetailConfig = field(default_factory=DetailConfig)
    """Number of Gaussians where none is given."""
    initial_opacity: float = 0.3
    """Opacity of the Gaussians at the start of the first frame."""
    first_frame_steps: int | None = None
    """Steps of the first frame, one view each; None: until it has converged."""
    first_frame_seconds: float | None = None
    """Time of the first frame, from which the number of its steps follows; None: `first_frame_steps`."""
    convergence: ConvergenceConfig = field(default_factory=ConvergenceConfig)
    """Convergence of the first frame."""
    cross_validation: CrossValidationConfig = field(default_factory=CrossValidationConfig)
    """Cross-validation of the first frame."""
    dropping: float | None = None
    """Probability with which each step of the first frame leaves a Gaussian out (see `dropping`); None: chosen by
    cross-validation, or by the noise of fewer than `min_views` views."""
    noise_aware: bool = True
    """Fit the first frame to noisy images by L1 alone: SSIM makes the fit follow their noise."""
    refine_cameras: Literal["off", "auto", "on"] = "off"
    """Refine poses and intrinsics on the first frame: off, auto (taken if withheld pixels show that they are better) or
    on (always taken)."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """Refinement of the cameras."""
    exposure: Literal["off", "auto", "on"] = "off"
    """Estimate gain and bias of each camera and frame: off, auto (differences between the cameras are taken if withheld
    pixels show that they are real) or on (always taken)."""
    exposures: ExposureConfig = field(default_factory=ExposureConfig)
    """Estimation of the exposures."""
    sh_band_fraction: float = 1 / 30
    """Fraction of the first frame's steps after which another SH band is added, as in 3DGS."""
    confidence_steps: int = 40
    """Steps that learn the confidence of the first frame from the masks of its key views."""
    epochs: int = 8
    """Passes over all training views for every later frame; the paper's small variant takes 5."""
    skip_static: bool = True
    """Skip the Gaussians, blocks of pixels and views that cannot have changed (see `active_set`)."""
    early_stopping_tolerance: float = 1e-6
    """Relative decrease of L_recon over an epoch below which a later frame ends early; 0: never."""
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    """Weights of the losses."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Density control."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Learning rates of every later frame, which `rates_at` adapts to the epoch."""
    decay_means_rate: bool = True
    """Let the learning rate of the means decay within a later frame."""
    means_rate_epochs: int = 2
    """Epochs before that decay begins."""
    rates_epochs: int = 8
    """Number of epochs that `rates` were chosen for: other parameters get larger rates in fewer epochs."""
    first_frame_rates: LearningRates = field(
        default_factory=lambda: LearningRates(means=2e-3, scales=0.02, quats=0.02, opacities=0.2, confidence=0.2)
    )
    """Learning rates at the start of the first frame. That of the confidence is constant: nothing else changes then."""
    final_rate: float = 0.1
    """Learning rates at the end of the first frame, as a fraction of those at its start."""

    def __post_init__(self) -> None:
        lowest = {"first_frame_steps": 1, "epochs": 1, "num_gaussians": 1, "confidence_steps": 0}
        lowest |= {"means_rate_epochs": 1, "rates_epochs": 1, "early_stopping_tolerance": 0}
        for name, low in lowest.items():
            if getattr(self, name) is not None and not getattr(self, name) >= low:
                raise ValueError(f"FitConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")
        if self.exposure not in ("off", "auto", "on"):
            raise ValueError(f"FitConfig(): `exposure` must be off, auto or on, got {self.exposure!r}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"FitConfig(): `sh_degree` must be 0 to 3, got {self.sh_degree}.")
        if not 0 < self.initial_opacity < 1:
            raise ValueError(f"FitConfig(): `initial_opacity` must lie between 0 and 1, got {self.initial_opacity}.")
        if self.first_frame_seconds is not None and not 0 < self.first_frame_seconds < inf:
            raise ValueError(
                f"FitConfig(): `first_frame_seconds` must be positive, or None, got {self.first_frame_seconds}."
            )
        if self.dropping is not None and not 0 <= self.dropping < 1:
            raise ValueError(f"FitConfig(): `dropping` must be 0 to less than 1, or None, got {self.dropping}.")
        if not 0 < self.final_rate <= 1:
            raise ValueError(f"FitConfig(): `final_rate` must be above 0 and at most 1, got {self.final_rate}.")

    def rates_at(self, epoch: int) -> LearningRates:
        """Return the learning rates of an epoch of a later frame, counted from 0.

        That of the means is constant in the first `means_rate_epochs` and then falls like 1 / (epoch + 1), so that a
        mean that has nearly arrived does not leave again. All others are larger by (rates_epochs / epochs)^1/2: fewer
        steps have to go as far.
        """
        means = min(1.0, self.means_rate_epochs / (epoch + 1)) if self.decay_means_rate else 1.0
        others = (self.rates_epochs / self.epochs) ** 0.5
        scaled = {n: (means if n == "means" else others) * rate for n, rate in asdict(self.rates).items()}
        return LearningRates(**scaled)

    @property
    def planned_steps(self) -> int:
        """Number of steps that the first frame is planned with."""
        return self.convergence.steps if self.first_frame_steps is None else self.first_frame_steps

    @property
    def planned_gaussians(self) -> int:
        """Largest number of Gaussians of the first frame."""
        return self.detail.most_gaussians if self.num_gaussians is None else self.num_gaussians

    @property
    def first_count(self) -> int:
        """Number of Gaussians that the first frame starts from."""
        return -(-self.planned_gaussians // 2) if self.density.rounds else self.planned_gaussians
