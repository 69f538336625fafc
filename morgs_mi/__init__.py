"""Dynamic Gaussian splatting for Mitsuba 3."""

from morgs_mi.core.interrupts import begin_command
from morgs_mi.core.llvm import ensure_llvm

begin_command()
# Before anything imports Dr.Jit, which looks for LLVM at that moment.
ensure_llvm()

from morgs_mi.capture.capture import Capture, load_capture  # noqa: E402
from morgs_mi.capture.truth import load_tracks, load_truth  # noqa: E402
from morgs_mi.codec.codec_config import CodecConfig  # noqa: E402
from morgs_mi.core.camera import Camera  # noqa: E402
from morgs_mi.core.color_space import SH_C0  # noqa: E402
from morgs_mi.core.gaussians import Gaussians  # noqa: E402
from morgs_mi.core.progress import ProgressBar  # noqa: E402
from morgs_mi.core.rig import with_near_planes  # noqa: E402
from morgs_mi.evaluate.evaluate import evaluate_stream  # noqa: E402
from morgs_mi.evaluate.point_tracks import PointTracks, track_points  # noqa: E402
from morgs_mi.fit.fit_config import FitConfig  # noqa: E402
from morgs_mi.gaussian_integrator import ellipsoids  # noqa: E402  (registers the integrator `gaussian_splat`)
from morgs_mi.loop.stream_config import StreamConfig  # noqa: E402
from morgs_mi.method.motion_config import MotionConfig  # noqa: E402
from morgs_mi.playback.export.tracks import extract_tracks  # noqa: E402
from morgs_mi.playback.player import channel_image, render_stream  # noqa: E402
from morgs_mi.playback.streams import open_stream  # noqa: E402
from morgs_mi.playback.visualise import confidence_image, depth_image, motion_image  # noqa: E402
from morgs_mi.plugins.light_probe import light_probe  # noqa: E402
from morgs_mi.plugins.shadows import shadow_ratio, shadowed  # noqa: E402
from morgs_mi.plugins.splat_rays import SplatRays  # noqa: E402
from morgs_mi.render.kernel_recording import render_lock  # noqa: E402
from morgs_mi.render.rasterize import Image, rasterize  # noqa: E402
from morgs_mi.render.render_config import RenderConfig  # noqa: E402
from morgs_mi.runs.live.live_frames import live_frames  # noqa: E402
from morgs_mi.runs.recorder import stream_capture  # noqa: E402
from morgs_mi.stream_loop import FrameReport, StreamLoop  # noqa: E402
from morgs_mi.synth.synth_config import SynthConfig  # noqa: E402
from morgs_mi.synth.synthesize import synthesize  # noqa: E402

__all__ = [
    "SH_C0",
    "Camera",
    "Capture",
    "CodecConfig",
    "FitConfig",
    "FrameReport",
    "Gaussians",
    "Image",
    "MotionConfig",
    "PointTracks",
    "ProgressBar",
    "RenderConfig",
    "SplatRays",
    "StreamConfig",
    "StreamLoop",
    "SynthConfig",
    "channel_image",
    "confidence_image",
    "depth_image",
    "ellipsoids",
    "evaluate_stream",
    "extract_tracks",
    "light_probe",
    "live_frames",
    "load_capture",
    "load_tracks",
    "load_truth",
    "motion_image",
    "open_stream",
    "rasterize",
    "render_lock",
    "render_stream",
    "shadow_ratio",
    "shadowed",
    "stream_capture",
    "synthesize",
    "track_points",
    "with_near_planes",
]
