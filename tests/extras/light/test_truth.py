"""An object inserted into a fitted clip, beside the path-traced clip that has it."""

from dataclasses import replace

import cv2
import mitsuba as mi
import numpy as np
import pytest

from morgs_mi import FitConfig, StreamConfig, SynthConfig, open_stream, stream_capture, synthesize
from morgs_mi.capture.capture import load_capture
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.extras.light.insert import InsertConfig, render_inserted
from morgs_mi.extras.synth.path_tracer import PathTracer
from morgs_mi.extras.synth.scene import Object, load_scene

BALL = {
    "type": "sphere",
    "center": [0.75, 0.3, 0.9],
    "radius": 0.3,
    "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.2]}},
}


@pytest.mark.long
def test_render_inserted__agrees_with_the_path_traced_clip(tmp_path):
    mi.set_log_level(mi.LogLevel.Error)
    synthesize(
        "spheres",
        tmp_path / "clip",
        SynthConfig(cameras=7, frames=2, width=160, height=120, spp=16),
    )
    config = StreamConfig(fit=FitConfig(num_gaussians=6000, first_frame_steps=400, epochs=2))
    stream_capture(load_capture(tmp_path / "clip"), tmp_path / "fit", config)
    stream = open_stream(tmp_path / "fit")
    scene = load_scene("spheres")
    camera = stream.cameras[0]

    def traced(objects):
        tracer = PathTracer(replace(scene, objects={**scene.objects, **objects}))
        return tracer.render(camera, 64, 0) / 255

    def build(frame, time):
        lamps = {name: light.shape for name, light in scene.lights.items()}
        return {
            "ball": BALL,
            **lamps,
            "integrator": {"type": "direct", "emitter_samples": 2, "bsdf_samples": 0},
        }

    image_without = traced({})
    truth = traced({"ball": Object({"ball": BALL})})
    image, unshadowed = (
        next(
            render_inserted(
                stream, camera, build, [0], ("color", "surfaces"), InsertConfig(64, shadows)
            )
        )[1]
        for shadows in (True, False)
    )
    coverage = image["surfaces"][..., 3]
    changed = np.abs(truth - image_without).max(-1) > 8 / 255
    near_ball = cv2.dilate(np.uint8(coverage > 0), np.ones((5, 5))) > 0
    ball = changed & (coverage > 0.99)
    shadow = changed & ~near_ball
    assert ball.sum() > 500
    assert shadow.sum() > 100
    assert psnr(image["color"][ball], truth[ball]) > 36
    assert psnr(image["color"][shadow], truth[shadow]) > 25
    assert (
        psnr(image["color"][shadow], truth[shadow])
        > psnr(unshadowed["color"][shadow], truth[shadow]) + 10
    )
