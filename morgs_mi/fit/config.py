"""How Gaussians are fitted to pictures."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FitConfig"]


@dataclass(frozen=True)
class FitConfig:
    """Settings of the optimisation; learning rates are Adam's, per step.

    The rates and the loss are those of 3DGS (Kerbl et al. 2023) where it has them.
    """

    sh_degree: int = 1
    """Degree of the spherical harmonics, 0 to 3; 0 is enough where nothing shines."""
    num_gaussians: int = 20_000
    """Gaussians of the first frame: fewer points are filled up between neighbours, more are thinned out."""
    first_frame_steps: int = 600
    """Steps (one view each) for the first frame."""
    confidence_steps: int = 40
    """Steps that learn the confidence of the first frame from the masks of its key views."""
    epochs: int = 8
    """Passes over all training views for every later frame; the paper's small variant takes 5."""
    dssim_weight: float = 0.2
    """lambda of eq. 2."""
    rate_means: float = 5e-4
    """Of centres, motion and offset, times the scene's extent."""
    rate_scales: float = 5e-3
    """Of log_scales."""
    rate_quats: float = 5e-3
    """Of quats."""
    rate_opacities: float = 0.05
    """Of logit_opacities."""
    rate_sh_dc: float = 2.5e-3
    """Of the constant SH coefficient."""
    rate_sh_rest: float = 1.25e-4
    """Of the other SH coefficients, a twentieth, as in 3DGS."""
    rate_confidence: float = 0.05
    """Of logit_confidence."""
    first_frame_boost: float = 4.0
    """Rates of the first frame, times the ones above, at its start; they fall to a tenth of that to its end."""

    def __post_init__(self) -> None:
        for name, low in (("first_frame_steps", 1), ("epochs", 1), ("num_gaussians", 1), ("confidence_steps", 0)):
            if getattr(self, name) < low:
                raise ValueError(f"FitConfig(): `{name}` must be at least {low}, got {getattr(self, name)}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"FitConfig(): `sh_degree` must be 0 to 3, got {self.sh_degree}.")

    def rates(self, extent: float) -> dict[str, float]:
        """Return the learning rate of every parameter by name; `extent` in world units."""
        means = self.rate_means * extent
        return {
            "means": means,
            "motion": means,
            "offset": means,
            "log_scales": self.rate_scales,
            "quats": self.rate_quats,
            "logit_opacities": self.rate_opacities,
            "sh_dc": self.rate_sh_dc,
            "sh_rest": self.rate_sh_rest,
            "logit_confidence": self.rate_confidence,
        }
