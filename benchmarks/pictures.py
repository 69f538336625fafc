"""Draw the demo as a moving picture for the README, and the stages of one frame of its clip for the
page docs/how-it-works.md.

    morgs-mi demo out/demo
    python -m benchmarks.pictures

Without the demo, its clip alone is made. All stages show one key view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np

import morgs_mi
from morgs_mi.codec.packets import CodedFrame
from morgs_mi.core.camera import Camera
from morgs_mi.core.gaussians import Gaussians, displaced
from morgs_mi.extras.demo.demo import DemoConfig
from morgs_mi.extras.synth.synthesize import synthesize
from morgs_mi.io.video import VideoReader
from morgs_mi.loop.observation import FrameObservation, observe_frame
from morgs_mi.method.active_set import full_active_set
from morgs_mi.method.lift import lift_flow
from morgs_mi.playback.visualise import confidence_image, grey_image, motion_image, to_uint8
from morgs_mi.stream_loop import StreamLoop

_CAPTURE = Path("out/demo/capture")
_VIDEO = Path("out/demo/side_by_side.mp4")
_MOVING_PICTURE = Path("docs/demo.webp")
_QUALITY = 80
_OUT = Path("docs/how-it-works")
_FRAME = 5  # a multiple of `mask_interval`, at which motion masks are computed
_ERROR_GAIN = 10
_JPEG_QUALITY = 90


def main() -> None:
    """Write the moving picture, fit the clip up to the frame, and write a JPEG file per stage."""
    mi.set_variant("llvm_ad_rgb")
    if _VIDEO.exists():
        video = VideoReader.open(_VIDEO)
        animation = cv2.Animation()
        animation.frames = [frame[..., ::-1].copy() for frame in video.frames()]
        animation.durations = [round(1e3 / (video.fps or 1))] * video.num_frames
        cv2.imwriteanimation(str(_MOVING_PICTURE), animation, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    config = DemoConfig()
    if not _CAPTURE.exists():
        synthesize(config.scene, _CAPTURE, replace(config.clip, seed=config.stream.seed))
    capture = morgs_mi.load_capture(_CAPTURE)
    loop = StreamLoop.of(capture, config.stream)
    frames = [
        [frame.images[v] for v in capture.train_views] for frame in capture.frames(0, _FRAME + 1)
    ]
    for images in frames[:-1]:
        loop.push(images)
    _OUT.mkdir(parents=True, exist_ok=True)
    for name, picture in draw(loop, frames[-1]).items():
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(_OUT / f"{name}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])


def draw(loop: StreamLoop, images: Sequence[np.ndarray | None]) -> dict[str, np.ndarray]:
    """Push the next frame and return the image [H, W, 3] of each stage in the key view that changes
    most, by name.
    """
    setup = loop.setup
    state = loop.state
    observation = observe_frame(setup, state.frame, state.history, images)
    changes = observation.changes or {}
    view = max(observation.flows, key=lambda v: changes[v].sum())
    camera = setup.cameras[view]
    flow = observation.flows[view]
    old_gaussians = loop.gaussians
    image = observation.history.images[view]
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
    return {
        "image": image,
        "changes": grey_image(changes[view].astype(float)),
        "flow": motion_image(np.where(flow.reliable[..., None], flow.motion, np.nan), scale),
        "mask": grey_image(flow.mask.astype(float)),
        "lifted": motion_image(_channel(lifted_gaussians, camera, "motion"), scale),
        "motion": motion_image(_channel(new_gaussians, camera, "motion"), scale),
        "confidence": confidence_image(_channel(new_gaussians, camera, "confidence")),
        "residual": confidence_image(_changed_share(state.coded, state_after, camera)),
        "render": to_uint8(np.clip(picture, 0, 1)),
        "error": to_uint8(np.clip(_ERROR_GAIN * np.abs(picture - image / 255), 0, 1)),
    }


def _lifted(gaussians: Gaussians, loop: StreamLoop, observation: FrameObservation) -> Gaussians:
    """Return the Gaussians after the displacement that explains the flow of the key views best
    (`lift_flow`).
    """
    cameras = {v: loop.setup.cameras[v] for v in observation.flows}
    views = full_active_set(gaussians, cameras, loop.setup.config.render).views
    return displaced(gaussians, lift_flow(gaussians, views, observation.flows).displacement)


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
