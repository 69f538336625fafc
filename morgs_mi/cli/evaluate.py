"""`morgs-mi eval`: the quality, motion, size and speed of a stream."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tyro.conf import Positional

from morgs_mi.cli.console import OUT, print_result, print_warning, progress
from morgs_mi.evaluate.results import Evaluation
from morgs_mi.evaluate.tables import evaluation_summary, evaluation_tables

__all__ = ["Eval"]


@dataclass(frozen=True)
class Eval:
    """Measure a stream against its capture: quality, motion, bytes and seconds."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    capture: Path | None = None
    """Folder of the capture, if it has moved since the fit."""
    json: Path | None = None
    """File for all results; - prints them instead of the tables."""
    figures: Path | None = None
    """Folder for slice.png (one column over time), motion.png, confidence.png and, if the stream holds offsets,
    offset.png."""
    lpips: Path | None = None
    """LPIPS network as ONNX with inputs in0 and in1, RGB [1, 3, H, W] from -1 to 1; the package includes none."""

    def run(self) -> None:
        from morgs_mi.core.files import json_finite, write_json
        from morgs_mi.evaluate.environment import machine, versions
        from morgs_mi.evaluate.evaluate import evaluate_stream
        from morgs_mi.evaluate.figures import draw_stream
        from morgs_mi.evaluate.lpips import Lpips

        network = None if self.lpips is None else Lpips(self.lpips)
        with progress() as report:
            result = evaluate_stream(self.out, self.capture, partial(report, "Evaluating frames"), network)
            if self.figures is not None:
                draw_stream(self.out, self.figures, self.capture, partial(report, "Drawing frames"))
        scores = {**result.as_dict(), "machine": machine(), "versions": versions()}
        if self.json == Path("-"):
            print_result(json.dumps(json_finite(scores), indent=2))
            return
        _print_evaluation(result)
        if self.json is not None:
            write_json(self.json, scores)
            print_result(f"All results: {self.json}")
        if self.figures is not None:
            print_result(f"Figures: {self.figures}")


def _print_evaluation(result: Evaluation) -> None:
    """Print an evaluation."""
    for table in evaluation_tables(result):
        OUT.print(table)
    for sentence in evaluation_summary(result):
        print_result(sentence)
    if not result.complete:
        print_warning(f"{result.stream}: the fit was not finished, its stream holds {result.num_frames} frames.")
