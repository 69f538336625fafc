"""`morgs-mi eval`: the quality, motion, size and speed of a stream."""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from morgs_mi.capture.outputs import check_output
from morgs_mi.cli.console import print_next, print_result, print_table, print_warning, progress
from morgs_mi.cli.settings import (
    Flag,
    optional,
    options,
)
from morgs_mi.evaluate.tables import evaluation_summary, evaluation_tables
from morgs_mi.platform.checks import few
from morgs_mi.runs.fit_files import FILES


@options
class Eval:
    """Measure a stream against its capture: quality, motion, bytes and seconds."""

    source: Positional[Path]
    """Folder of a fit, or a stream file."""
    capture: Annotated[Path | None, optional("FOLDER")] = None
    """Capture that was fitted, if it has moved since the fit."""
    any_recording: Flag = False
    """Compare with CAPTURE even if it is another recording by the same cameras."""
    json: Annotated[Path | None, optional("FILE.json")] = None
    """File for all results; - prints them instead of the tables."""
    lpips: Annotated[Path | None, optional("FILE.onnx")] = None
    """LPIPS network as ONNX with inputs in0 and in1, RGB [1, 3, H, W] from -1 to 1; the package
    includes none.
    """

    def run(self) -> None:
        from morgs_mi.evaluate.evaluate import evaluate_stream
        from morgs_mi.evaluate.lpips import Lpips
        from morgs_mi.platform.environment import machine, versions
        from morgs_mi.platform.files import json_finite, write_json

        folder = self.source if self.source.is_dir() else self.source.parent
        files_of_fit = [
            os.path.realpath(path) for path in (self.source, *(folder / name for name in FILES))
        ]
        output = None if self.json == Path("-") else self.json
        if output is not None and os.path.realpath(check_output(output)) in files_of_fit:
            raise ValueError(
                f"{output}: expected a new file, got one that the fit has written; choose another "
                "name."
            )
        network = None
        if self.lpips is not None:
            network = Lpips(self.lpips)
        with progress() as report:
            frames = partial(report, "Evaluating frames")
            result = evaluate_stream(self.source, self.capture, frames, network, self.any_recording)
        scores = {**result.as_dict(), "machine": machine(), "versions": versions()}
        if self.json == Path("-"):
            print_result(json.dumps(json_finite(scores), indent=2))
            return
        for table in evaluation_tables(result):
            print_table(table)
        for sentence in evaluation_summary(result):
            print_result(sentence)
        if result.without_images:
            print_warning(
                f"{result.stream}: frames {few(result.without_images)} were fitted without any "
                "image, or have none to compare with; fit them again."
            )
        if not result.complete:
            print_warning(
                f"{result.stream}: the fit was not finished, its stream holds {result.num_frames} "
                "frames."
            )
        if output is not None:
            write_json(output, scores)
            print_result(f"All results: {output}")
        print_next("view", self.source)
