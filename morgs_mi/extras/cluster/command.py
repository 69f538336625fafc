"""`morgs-mi fit` with the options --chunks and --scheduler."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from morgs_mi.cli.console import progress
from morgs_mi.cli.fit import Fit
from morgs_mi.cli.settings import optional, options
from morgs_mi.platform.config import Count, check_value
from morgs_mi.platform.threads import usable_cores

if TYPE_CHECKING:
    from pathlib import Path

    from morgs_mi.capture.capture import Capture
    from morgs_mi.loop.frame_report import FrameReport
    from morgs_mi.loop.stream_config import StreamConfig


@options
class FitInChunks(Fit):
    """Reconstruct a capture, frame after frame, into OUT/stream.morgs.

    All other settings are in a file, see --print-config and --config.

    The file overrides the preset; options override both.
    """

    chunks: int = 1
    """Number of parts of the recording that are fitted side by side, by the extra cluster; each
    begins with a keyframe."""
    scheduler: Annotated[str | None, optional("ADDRESS")] = None
    """Dask scheduler whose workers fit them, such as tcp://host:8786 (docs/captures.md)."""

    def run(self) -> None:
        check_value("fit()", "chunks", self.chunks, Count)
        super().run()

    def fit(self, capture: Capture, out: Path, config: StreamConfig) -> list[FrameReport]:
        from morgs_mi.extras.cluster.chunks import ChunkedRun, noting_chunks
        from morgs_mi.extras.cluster.tasks import ChunkConfig
        from morgs_mi.extras.cluster.workers import open_client

        if self.chunks == 1 and self.scheduler is None:
            return super().fit(capture, out, config)
        chunks = ChunkConfig(self.chunks)
        with (
            noting_chunks(out),
            progress() as report,
            open_client(self.scheduler, min(chunks.count, usable_cores())) as client,
        ):
            return ChunkedRun(capture, out, client, config, chunks, report).fit(self.resume)
