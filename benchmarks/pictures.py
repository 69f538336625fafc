"""Draw the demo as a moving picture for the README, recordings beside their fits for the page
docs/cameras.md, and the stages of one frame of the demo's clip for docs/how-it-works.md.

    morgs-mi demo out/demo
    morgs-mi fit out/demo/capture out/fair --exclude cam01 cam02 cam03 cam04 cam06 \
        --num-gaussians 20000 --first-frame-steps 750
    morgs-mi fit walk4 out/walk4 --frames 20 --downscale 4 --hold-out cam02 \
        --num-gaussians 10000 --first-frame-steps 900
    python -m benchmarks.pictures

Without a fit, its picture is left as it is; the demo's clip is made. All stages show one key view.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np

import morgs_mi
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.evaluate.comparison import ComparedClip
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.extras.synth.demo import DemoConfig
from morgs_mi.extras.synth.synthesize import synthesize
from morgs_mi.io.video import VideoReader
from morgs_mi.loop.input_images import FrameImages
from morgs_mi.loop.observation import FrameObservation, observe_frame
from morgs_mi.method.flow import ViewFlow
from morgs_mi.method.lift import lift_flow
from morgs_mi.playback.player import explained_image
from morgs_mi.playback.streams import open_stream
from morgs_mi.playback.visualise import label, side_by_side, to_uint8
from morgs_mi.render.active_view import ActiveView
from morgs_mi.stream_loop import StreamLoop

_CAPTURE = Path("out/demo/capture")
_VIDEO = Path("out/demo/side_by_side.mp4")
_MOVING_PICTURE = Path("docs/demo.webp")
# Fits by the expected quality of views between their cameras.
_FITS = {
    "good": Path("out/demo/stream"),
    "fair": Path("out/fair"),
    "poor": Path("out/walk4"),
}
_CLIPS = Path("docs/recordings")
_QUALITY = 80
# Shortest duration of a clip in seconds; a shorter one is played more slowly.
_LEAST_SECONDS = 3
_OUT = Path("docs/how-it-works")
_FRAME = 5  # a multiple of `mask_interval`, at which motion masks are computed
_JPEG_QUALITY = 90


def main() -> None:
    """Write the moving pictures, fit the clip up to the frame, and write a JPEG file per stage."""
    mi.set_variant("llvm_ad_rgb")
    if _VIDEO.exists():
        video = VideoReader.open(_VIDEO)
        write_animation(_MOVING_PICTURE, video.frames(), video.fps or 1)
    for quality, fit in _FITS.items():
        if fit.exists():
            clip = ComparedClip.of(open_stream(fit), None)
            write_animation(_CLIPS / f"{quality}.webp", compared(clip), clip.stream.fps)
    config = DemoConfig()
    if not _CAPTURE.exists():
        synthesize(config.scene, _CAPTURE, replace(config.clip, seed=config.stream.seed))
    capture = morgs_mi.load_capture(_CAPTURE)
    loop = StreamLoop.of(capture, config.stream)
    frames = [frame.train for frame in capture.frames(0, _FRAME + 1)]
    for images in frames[:-1]:
        loop.push(images)
    _OUT.mkdir(parents=True, exist_ok=True)
    for name, picture in draw(loop, frames[-1]).items():
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(_OUT / f"{name}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def write_animation(path: Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Write images [H, W, 3] as an animated WebP file, at `fps` or more slowly."""
    path.parent.mkdir(parents=True, exist_ok=True)
    animation = cv2.Animation()
    animation.frames = [image[..., ::-1].copy() for image in images]
    count = len(animation.frames)
    animation.durations = [round(1e3 * max(1 / fps, _LEAST_SECONDS / count))] * count
    cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])


def compared(clip: ComparedClip) -> Iterable[np.ndarray]:
    """Yield the first held-out view of a fit side by side: recorded, rendered, and the error."""
    for frame in clip.frames():
        view = next(iter(frame.views()))
        score = psnr(view.rendered, view.recorded, view.valid)
        yield side_by_side(
            [
                label(view.recorded, "recorded"),
                label(view.rendered, f"rendered, {score:.1f} dB"),
                explained_image("error", np.abs(view.rendered / 255 - view.recorded / 255)),
            ]
        )


def draw(loop: StreamLoop, images: FrameImages) -> dict[str, np.ndarray]:
    """Push the next frame and return the image [H, W, 3] of each stage in the key view that changes
    most, by name.
    """
    setup = loop.setup
    state = loop.state
    observation = observe_frame(setup, state.frame, state.history, images)
    view = max(observation.key_views, key=lambda v: observation.views[v].change.sum())
    seen = observation.views[view]
    camera = seen.camera
    image = seen.image
    flow = observation.key_views[view].flow
    old_gaussians = loop.gaussians
    assert old_gaussians is not None
    assert state.coded is not None
    assert flow.mask is not None, "motion masks are computed at multiples of `mask_interval`"
    lifted_gaussians = _lifted(old_gaussians, loop, observation)
    loop.push(images)
    new_gaussians = loop.gaussians
    state_after = loop.state.coded
    assert new_gaussians is not None
    assert state_after is not None
    picture = _channel(new_gaussians, camera, "color")
    # Fully saturated at a speed that the fastest pixels reach.
    scale = float(np.percentile(np.linalg.norm(flow.motion[flow.mask], axis=-1), 95))
    flow_image = np.where(flow.reliable[..., None], flow.motion, 0)
    lifted_motion = _channel(lifted_gaussians, camera, "motion")
    new_motion = _channel(new_gaussians, camera, "motion")
    share = _changed_share(state.coded, state_after, camera)
    return {
        "image": image,
        "changes": to_uint8(seen.change.astype(float)),
        "flow": explained_image("motion", flow_image, scale, "flow", image),
        "mask": to_uint8(flow.mask.astype(float)),
        "lifted": explained_image("motion", lifted_motion, scale, "lifted flow", picture),
        "motion": explained_image("motion", new_motion, scale, color=picture),
        "confidence": explained_image("confidence", _channel(new_gaussians, camera, "confidence")),
        "residual": explained_image("confidence", share, title="share"),
        "render": to_uint8(np.clip(picture, 0, 1)),
        "error": explained_image("error", np.abs(picture - image / 255)),
    }


def _lifted(gaussians: Gaussians, loop: StreamLoop, observation: FrameObservation) -> Gaussians:
    """Return the Gaussians after the displacement that explains the flow of the key views best
    (`lift_flow`).
    """
    render = loop.setup.config.render
    flows = [
        ViewFlow(ActiveView(loop.setup.cameras[v], render), view.flow)
        for v, view in observation.key_views.items()
    ]
    return displaced(gaussians, lift_flow(gaussians, flows).displacement)


def _channel(gaussians: Gaussians, camera: Camera, name: str) -> np.ndarray:
    return np.asarray(morgs_mi.rasterize(gaussians, camera, (name,))[name])


def _changed_share(old_state: CodedFrame, new_state: CodedFrame, camera: Camera) -> np.ndarray:
    """Return the share [H, W, 1] of each pixel that Gaussians have which the residual packet
    changed.
    """
    rows = {number: row for row, number in enumerate(old_state.ids)}
    same = [
        number in rows and np.array_equal(old_state.grid.values[rows[number]], values)
        for number, values in zip(new_state.ids, new_state.grid.values, strict=True)
    ]
    mask = np.logical_not(same)[:, None].astype(np.float32)
    gaussians = replace(new_state.gaussians, motion=None, offset=None)
    return np.asarray(morgs_mi.rasterize(gaussians, camera, ("alpha",), features=mask).features)


if __name__ == "__main__":
    main()
