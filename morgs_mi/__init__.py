"""Dynamic Gaussian splatting for Mitsuba 3."""

from morgs_mi.core.llvm import ensure_llvm

# Before anything imports Dr.Jit, which looks for LLVM at that moment.
ensure_llvm()

from morgs_mi.capture.capture import Capture, load_capture  # noqa: E402
from morgs_mi.capture.live import live_frames  # noqa: E402
from morgs_mi.config import StreamConfig  # noqa: E402
from morgs_mi.core.camera import Camera  # noqa: E402
from morgs_mi.core.gaussians import Gaussians  # noqa: E402
from morgs_mi.gaussian_integrator import ellipsoids  # noqa: E402  (registers the integrator `gaussian_splat`)
from morgs_mi.playback.player import open_stream, render_stream  # noqa: E402
from morgs_mi.recorder import stream_capture  # noqa: E402
from morgs_mi.render.config import RenderConfig  # noqa: E402
from morgs_mi.render.rasterize import Image, rasterize  # noqa: E402
from morgs_mi.stream_loop import FrameReport, StreamLoop  # noqa: E402

__all__ = [
    "Camera",
    "Capture",
    "FrameReport",
    "Gaussians",
    "Image",
    "RenderConfig",
    "StreamConfig",
    "StreamLoop",
    "ellipsoids",
    "live_frames",
    "load_capture",
    "open_stream",
    "rasterize",
    "render_stream",
    "stream_capture",
]
