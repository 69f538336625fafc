"""Dynamic Gaussian splatting for Mitsuba 3."""

from morgs_mi.core.llvm import ensure_llvm

# Before anything imports Dr.Jit, which looks for LLVM at that moment.
ensure_llvm()

from morgs_mi.core.camera import Camera  # noqa: E402
from morgs_mi.core.gaussians import Gaussians  # noqa: E402
from morgs_mi.gaussian_integrator import ellipsoids  # noqa: E402  (registers the integrator `gaussian_splat`)
from morgs_mi.render.config import RenderConfig  # noqa: E402
from morgs_mi.render.rasterize import Image, rasterize  # noqa: E402

__all__ = ["Camera", "Gaussians", "Image", "RenderConfig", "ellipsoids", "rasterize"]
