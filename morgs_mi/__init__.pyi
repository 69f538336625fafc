"""The public names, each of which is loaded when it is first used."""

from .capture.capture import Capture, load_capture
from .capture.truth import load_tracks, load_truth
from .codec.codec_config import CodecConfig
from .core.camera import Camera
from .core.color_space import SH_C0
from .core.gaussians import Gaussians
from .core.rig import with_near_planes
from .core.view import View
from .evaluate.accuracy import accuracy
from .evaluate.evaluate import evaluate_stream
from .extras.light.insert import shadow_ratio, shadowed
from .extras.light.light_probe import light_probe
from .extras.live.sources import live_frames
from .extras.sweep.sweep import SweepResult, leave_out, sweep
from .extras.sweep.vary import Vary
from .extras.synth.synth_config import SynthConfig
from .extras.synth.synthesize import synthesize
from .fit.density import DensityControl
from .fit.fit_config import DensityConfig, FitConfig
from .fit.initialise import from_points
from .gaussian_integrator import ellipsoids, update_ellipsoids
from .io.ply import write_ply
from .io.splats import read_splats
from .loop.first_frame import fit_gaussians
from .loop.frame_report import FrameReport
from .loop.stream_config import StreamConfig
from .method.motion_config import MotionConfig
from .method.objective import ObjectiveConfig, loss_term
from .platform.progress import ProgressBar
from .playback.player import channel_image, render_stream
from .playback.streams import open_stream
from .playback.visualise import confidence_image, depth_image, motion_image
from .render.active_view import ActiveView
from .render.kernel_recording import render_lock
from .render.rasterize import Image, rasterize, render_view
from .render.render_config import RenderConfig
from .runs.fit_capture import stream_capture
from .stream_loop import StreamLoop
from .surfaces.splat_rays import SplatRays

__all__ = [
    "SH_C0",
    "ActiveView",
    "Camera",
    "Capture",
    "CodecConfig",
    "DensityConfig",
    "DensityControl",
    "FitConfig",
    "FrameReport",
    "Gaussians",
    "Image",
    "MotionConfig",
    "ObjectiveConfig",
    "ProgressBar",
    "RenderConfig",
    "SplatRays",
    "StreamConfig",
    "StreamLoop",
    "SweepResult",
    "SynthConfig",
    "Vary",
    "View",
    "accuracy",
    "channel_image",
    "confidence_image",
    "depth_image",
    "ellipsoids",
    "evaluate_stream",
    "fit_gaussians",
    "from_points",
    "leave_out",
    "light_probe",
    "live_frames",
    "load_capture",
    "load_tracks",
    "load_truth",
    "loss_term",
    "motion_image",
    "open_stream",
    "rasterize",
    "read_splats",
    "render_lock",
    "render_stream",
    "render_view",
    "shadow_ratio",
    "shadowed",
    "stream_capture",
    "sweep",
    "synthesize",
    "update_ellipsoids",
    "with_near_planes",
    "write_ply",
]
