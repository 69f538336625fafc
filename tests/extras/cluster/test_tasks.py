"""Tasks that a worker refuses, and results that it stores."""

from dataclasses import replace

import mitsuba as mi
import pytest

from morgs_mi.capture.capture import load_capture
from morgs_mi.codec.codec_config import CodecConfig
from morgs_mi.codec.container import PacketKind, decode_packet
from morgs_mi.codec.packets import reemitted_keyframe
from morgs_mi.extras.cluster.tasks import Chunk, ChunkConfig, Fit, fit_frames, recording_of
from morgs_mi.extras.cluster.workers import installed
from tests.scenes.recording import CONFIG, write_recording


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    capture = load_capture(write_recording(tmp_path_factory.mktemp("clip"), 5))
    return Fit(recording_of(capture), CONFIG, ChunkConfig(), str(mi.variant()), installed())


@pytest.mark.slow
def test_fit_frames__begins_a_chunk_with_a_keyframe_after_the_common_model(fit):
    common = fit_frames(fit, Chunk(0, 2, 0), 2)
    start = (reemitted_keyframe(common.chunk.coded).encoded,)
    config = replace(fit.config, codec=CodecConfig(keyframe_interval=0))
    fit = replace(fit, config=config, chunks=ChunkConfig(2, passes=1, epochs=1, overlap=1))
    part = fit_frames(fit, Chunk(3, 5, 3, start), 5)
    kinds = [(packet.kind, packet.frame) for packet in map(decode_packet, part.packets)]
    assert kinds == [(PacketKind.KEYFRAME, 3), (PacketKind.RESIDUAL, 4)]
    assert [report.frame for report in part.reports] == [3, 4]
    assert [report.num_bytes for report in part.reports] == [len(packet) for packet in part.packets]


def test_fit_frames__refuses_other_versions(fit):
    versions = tuple((name, "0.1" if name == "drjit" else version) for name, version in installed())
    with pytest.raises(
        ValueError,
        match=r"versions, {'drjit': '0\.1'}, got {'drjit': '1\.5\.0'}; install",
    ):
        fit_frames(replace(fit, versions=versions), Chunk(0, 1, 0), 1)


def test_recording_of__opens_the_capture_as_it_is(tmp_path):
    capture = load_capture(write_recording(tmp_path, 5), 1.0, "cam1", 4)
    again = recording_of(capture)()
    assert (again.num_frames, again.test_views, again.names) == (4, (1,), capture.names)
