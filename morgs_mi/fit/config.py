"""How Gaussians are fitted to pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from math import inf

__all__ = ["DensityConfig", "FitConfig", "LearningRates"]


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rate of every parameter, per step.

    The defaults are those of a later frame. They were chosen on the clip `spheres`, held-out view, from 1x to
    8x the rates of 3DGS (Kerbl et al. 2023): 3DGS takes thousands of steps where a frame here has under a hundred.
    """

    means: float = 5e-4
    """Of centres, motion and offset, times the scene's extent."""
    scales: float = 1e-2
    """Of log_scales."""
    quats: float = 1e-2
    """Of quats."""
    opacities: float = 0.05
    """Of logit_opacities."""
    sh_dc: float = 1e-2
    """Of the constant SH coefficient."""
    sh_rest: float = 5e-4
    """Of the other SH coefficients, a twentieth, as in 3DGS."""
    confidence: float = 0.05
    """Of logit_confidence."""

    def __post_init__(self) -> None:
        for name, rate in asdict(self).items():
            if not 0 <= rate < inf:
                raise ValueError(f"Rates(): `{name}` must be finite and not negative, got {rate}.")

    def by_parameter(self, extent: float) -> dict[str, float]:
        """Return the rate of every parameter by its name; `extent` in world units."""
        means = self.means * extent
        return {
            "means": means,
            "motion": means,
            "offset": means,
            "log_scales": self.scales,
            "quats": self.quats,
            "logit_opacities": self.opacities,
            "sh_dc": self.sh_dc,
            "sh_rest": self.sh_rest,
            "logit_confidence": self.confidence,
        }


@dataclass(frozen=True)
class DensityConfig:
    """How the number of Gaussians follows the pictures (see `density`); thresholds are those of the literature."""

    rounds: int = 6
    """Steps of density control in the first frame, from a tenth to a half of its steps; 0: none. With them, the first
    frame starts from half of its Gaussians and grows to all."""
    later_frames: bool = True
    """One step of density control in every later frame, after five eighths of its epochs."""
    births: float = 0.02
    """Most births of a later frame, as a share of the Gaussians."""
    max_gaussians: int = 30_000
    """Beyond this many, nobody is born in a later frame unless another dies."""
    birth_opacity: float = 0.1
    """What is added in a later frame starts as faint as this."""
    split_scale: float = 0.01
    """In the first frame, who is wider than this share of the scene's extent is split, others are cloned."""
    min_error: float = 0.1
    """In a later frame, who answers for less error beyond noise, in pixels of full contrast, is nobody's parent."""
    min_opacity: float = 0.005
    """Who is fainter dies."""

    def __post_init__(self) -> None:
        for name, low in (("rounds", 0), ("births", 0), ("max_gaussians", 1), ("split_scale", 0), ("min_error", 0)):
            if not getattr(self, name) >= low:
                raise ValueError(f"DensityConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")
        for name in ("birth_opacity", "min_opacity"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"DensityConfig(): `{name}` must lie between 0 and 1, got {getattr(self, name)}.")


@dataclass(frozen=True)
class FitConfig:
    """Settings of the optimisation."""

    sh_degree: int = 1
    """Degree of the spherical harmonics, 0 to 3; 0 is enough where nothing shines."""
    num_gaussians: int = 20_000
    """Gaussians of the first frame; see `first_count` for those that it starts from."""
    first_frame_steps: int = 1500
    """Steps (one view each) for the first frame."""
    confidence_steps: int = 40
    """Steps that learn the confidence of the first frame from the masks of its key views."""
    epochs: int = 8
    """Passes over all training views for every later frame; the paper's small variant takes 5."""
    skip_static: bool = True
    """Leave out of a later frame which Gaussians, blocks of pixels and views cannot have changed; see `part`."""
    early_stopping_tolerance: float = 0.0
    """A later frame ends once a pass over its views lessens L_recon by less than this share of it; 0: when it grows."""
    dssim_weight: float = 0.2
    """lambda of eq. 2."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Births and deaths."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Learning rates of every later frame; `rates_at` makes them those of an epoch."""
    decay_means_rate: bool = True
    """Let the rates of places fall within a later frame, from its third epoch on."""
    first_frame_rates: LearningRates = field(
        default_factory=lambda: LearningRates(means=2e-3, scales=0.02, quats=0.02, opacities=0.2)
    )
    """Learning rates at the start of the first frame; they fall to a tenth of that to its end."""

    def __post_init__(self) -> None:
        for name, low in (("first_frame_steps", 1), ("epochs", 1), ("num_gaussians", 1), ("confidence_steps", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"FitConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"FitConfig(): `sh_degree` must be 0 to 3, got {self.sh_degree}.")

    def rates_at(self, epoch: int) -> LearningRates:
        """Return the learning rates of a later frame's epoch, counted from 0.

        Those of places are those of `rates` in the first two epochs, and then fall like 1 / (epoch + 1), for who is
        nearly in its place must not leave it again; without `decay_means_rate` they stay. All others are larger by
        (8 / epochs)^1/2 throughout: fewer steps have to go as far.
        """
        places, others = min(1.0, 2 / (epoch + 1)) if self.decay_means_rate else 1.0, (8 / self.epochs) ** 0.5
        return LearningRates(
            **{n: (places if n == "means" else others) * rate for n, rate in asdict(self.rates).items()}
        )

    @property
    def first_count(self) -> int:
        """How many Gaussians to start from: fewer points are filled up between neighbours, more are thinned out."""
        return -(-self.num_gaussians // 2) if self.density.rounds else self.num_gaussians
