"""Light between Gaussians and surfaces: probes, traced light, shadows, inserted scenes."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "integrators", {"splat_path": "splat_path:SplatPathIntegrator"})
    enter(__name__, "commands", {"render": "command:RenderWithScene"})
