"""The viewer of a live fit: it follows the stream, and has the recorded images that are added to the capture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from morgs_mi.capture.layouts.colmap import write_colmap
from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.packets import keyframe_packet
from morgs_mi.playback.viewer.viewer import Viewer, ViewerConfig
from morgs_mi.runs.live.live_capture import write_images
from tests.scenes import noise_capture
from tests.scenes.gaussians import isotropic

pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")


def test_viewer__follows_a_live_fit(tmp_path: Path) -> None:
    capture, rig, clip = tmp_path / "capture", noise_capture.rig(), noise_capture.clip(3)
    write_colmap(capture / "sparse" / "0", rig)
    (tmp_path / "capture.json").write_text(json.dumps({"capture": str(capture)}))
    splat, about = isotropic([[0, 0, 0]], 0.3, 0.9, (1.0, 0, 0)), {"reading": {"gaps": True}, "test_view": None}
    with StreamWriter(tmp_path / "stream.morgs", rig, 25, about) as writer:

        def add(frame: int) -> None:
            write_images(capture, noise_capture.NAMES, [clip[frame]] * 3, frame)
            writer.write(keyframe_packet(splat, frame))

        add(0)
        viewer = Viewer(tmp_path, ViewerConfig(port=0, follow=True))
        try:
            assert viewer._controls.follow.value
            np.testing.assert_array_equal(viewer._recorded_image(1, 0, rig[1]), clip[0])
            add(1)
            add(2)
            viewer._cache.refresh()
            np.testing.assert_array_equal(viewer._recorded_image(1, 2, rig[1]), clip[2])
        finally:
            viewer._server.stop()
