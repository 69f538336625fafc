"""The viewer starts with damaged and forged streams, shows the frames that play, and stops, or refuses them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from morgs_mi.codec.container import StreamWriter
from morgs_mi.codec.reader import StreamReader
from tests.codec.forge import damaged, with_forged_bytes, with_forged_header, with_forged_packets
from tests.scenes.short_clip import short_clip

pytest.importorskip("viser", reason="install it with pip install 'morgs-mi[viewer]'")


def watch(path: Path, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Show every frame of a stream forwards and backwards, with trajectories, and return what the page reports."""
    from morgs_mi.playback.viewer.viewer import Viewer

    viewer = Viewer(path)
    controls, reports = viewer._controls, set()
    count = len(viewer._cache.frames)
    frames = iter([*range(count), *range(count)[::-1]])
    controls.trails.value = True

    def wait(_: float) -> bool:
        reports.add(controls.status.content)
        controls.frame.value = frame = next(frames, -1)
        return frame < 0

    monkeypatch.setattr(viewer._stopped, "wait", wait)
    viewer.run()
    return reports


@pytest.mark.parametrize("capture", [5, ["a"], {"a": 1}, "\0", None])
def test_viewer__starts_whatever_a_header_calls_its_capture(tmp_path, monkeypatch, capture):
    clip = short_clip()
    (tmp_path / "clip").write_bytes(clip.data)
    reader = StreamReader(tmp_path / "clip")
    with StreamWriter(tmp_path / "s", reader.cameras, 25, {**reader.metadata, "capture": capture}) as writer:
        writer.write(next(iter(reader)))
    assert any(report.startswith("Frame 0 of 0, 6 Gaussians") for report in watch(tmp_path / "s", monkeypatch))


@pytest.mark.parametrize("forge", [damaged, with_forged_bytes, with_forged_packets, with_forged_header])
def test_viewer__shows_or_refuses_hostile_streams(tmp_path, monkeypatch, forge):
    path, wrong = tmp_path / "s", {}
    for seed in range(6):
        forged = forge(short_clip(), np.random.default_rng(seed))
        path.write_bytes(forged if isinstance(forged, bytes) else forged.data)
        try:
            reports = watch(path, monkeypatch)
        except ValueError as error:
            reports = {str(error)}
        wrong[seed] = [report for report in reports if report and not report.startswith(("Frame ", f"{path}: "))]
    assert not any(wrong.values()), wrong
