"""Memory that a fit takes at least, compared with the free memory before it begins."""

from __future__ import annotations

from collections.abc import Sequence

from morgs_mi.core.attributes import ATTRIBUTES
from morgs_mi.core.camera import Camera
from morgs_mi.core.memory import check_memory
from morgs_mi.fit.fit_config import FitConfig

# Arrays of each parameter: value, gradient and Adam's two moments.
_ARRAYS = 4
# Floats of a projected Gaussian.
_PROJECTED = 40
# Bytes of a float.
_FLOAT = 4
# Bytes of a pixel of a view: its image as bytes and as floats, and its reference.
_PIXEL = 30
# Gaussians for each pixel: far more than images determine, and such a fit would take days.
_MOST = 16
# Bytes of a step in the order of the views.
_STEP = 16


def check_capacity(place: str, cameras: Sequence[Camera], config: FitConfig) -> None:
    """Raise an error unless there is memory for the numbers of Gaussians and of steps that a config
    gives.

    Args:
        place: where the error's sentence begins.
        cameras: the views.
        config: settings.

    Raises:
        ValueError: there is not, or there are too many Gaussians for the pixels.
    """
    rest = 3 * ((config.sh_degree + 1) ** 2 - 1)
    floats = sum(rest if attribute.width < 0 else attribute.width for attribute in ATTRIBUTES)
    gaussian_bytes = _FLOAT * (_ARRAYS * floats + _PROJECTED)
    sizes = {"num_gaussians": gaussian_bytes, "first_frame_steps": _STEP}
    for name, size in sizes.items():
        count = getattr(config, name) or 0
        check_memory(place, size * count, f"`{name}={count}`", "set a smaller number")
    pixels = sum(camera.width * camera.height for camera in cameras)
    if (config.num_gaussians or 0) > _MOST * pixels:
        raise ValueError(
            f"{place}: `num_gaussians` must be at most {_MOST * pixels}, {_MOST} for each pixel of "
            f"the views, got {config.num_gaussians}; set a smaller number."
        )
    views = f"{len(cameras)} views with {pixels} pixels"
    check_memory(
        place, _PIXEL * pixels, views, "fit smaller images (`downscale`), or fewer cameras"
    )
