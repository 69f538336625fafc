"""`morgs-mi accuracy`: error against run time of the renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.capture.outputs import check_output
from morgs_mi.cli.console import print_result, print_table, progress
from morgs_mi.cli.settings import (
    options,
    place,
)
from morgs_mi.cli.streams import DropInvalid, opened


@options
class Accuracy:
    """Compare the renderer with a float64 reference, for a file of Gaussians or the first frame of
    a stream: error against run time along its settings.
    """

    source: Positional[Path]
    """File of Gaussians, .ply, .compressed.ply or .splat, folder of a fit, or a stream file."""
    output: Annotated[Positional[Path | None], place("FILE.png")] = None
    """Plot, beside which a .json has all results; by default stream-accuracy.png or
    FILE-accuracy.png beside SOURCE. Needs the extra plots.
    """
    camera: Annotated[tuple[str, ...], arg(metavar="CAMERA ...")] = ()
    """Cameras by index or name; by default the first one, for a file of Gaussians the one with most
    detail in view.
    """
    tolerance: float = 1e-3
    """Largest relative error of the image and of each gradient in all cameras, for the choice of
    the fastest settings.
    """
    drop_invalid: DropInvalid = False

    def run(self) -> None:
        from morgs_mi.evaluate.accuracy import accuracy
        from morgs_mi.platform.files import write_json
        from morgs_mi.platform.plots import check_plot
        from morgs_mi.playback.stream_header import find_camera

        stream = opened(self.source, self.drop_invalid)
        views = [find_camera(stream, camera) for camera in self.camera or (0,)]
        beside = stream.path.with_name(f"{stream.path.stem}-accuracy.png")
        plot = check_output(self.output or beside)
        check_plot(plot)
        gaussians = next(stream.states()).gaussians
        with progress() as report:
            result = accuracy(gaussians, views, tolerance=self.tolerance, progress=report)
        print_table(result.table())
        result.plot(plot, stream.path.name)
        results = plot.with_suffix(".json")
        write_json(results, result.as_dict())
        print_result(f"{result.sentence}\nPlot: {plot}\nAll results: {results}")
