"""Error and run time of the renderer's settings for a ball of Gaussians, by `morgs_mi.accuracy`.

python -m benchmarks.reports renderer --json out.json --plot out.png
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.reports.plots import markdown
from benchmarks.reports.study import Row
from benchmarks.speed.output import Output
from benchmarks.workloads import ball
from morgs_mi import accuracy
from morgs_mi.cli.console import print_table

_DEFAULT = "1/255, 0.0001"


@dataclass(frozen=True)
class Options(Output):
    """Measure error and run time of the renderer's settings, compared with a float64 reference."""

    plot: Path | None = None
    """Plot of error over run time, .png or .svg; needs matplotlib."""
    gaussians: int = 20_000
    """Number of Gaussians, uniform in a ball of radius 1 that fills the view."""
    width: int = 512
    """Width of the image, px."""
    height: int = 384
    """Height of the image, px."""

    def run(self) -> None:
        """Measure every setting, print the table, and write the figures."""
        result = accuracy(*ball(1, self.gaussians, self.width, self.height, 0.02, 1))
        print_table(result.table())
        if self.plot is not None:
            result.plot(self.plot)
        scene = {name: getattr(self, name) for name in ("gaussians", "width", "height")}
        self.write({"scene": scene, **asdict(result)}, unprinted=["rows", "config"])


def relative_times(rows: Sequence[Row]) -> dict[str, float]:
    """Return the times of the settings by name, relative to the default."""
    seconds = {row["name"]: row["seconds"] for row in rows}
    return {name: value / seconds[_DEFAULT] for name, value in seconds.items()}


def errors_table(rows: Sequence[Row]) -> str:
    """Return the relative time and the errors of the pairs of cut-offs."""
    times = relative_times(rows)
    lines = []
    for row in rows:
        if "," in row["name"]:
            name = f"**{row['name']}**" if row["name"] == _DEFAULT else row["name"]
            image, *gradients = row["errors"].values()
            cells = (f"{times[row['name']]:.2f}", f"{image:.0e}", f"{max(gradients):.0e}")
            lines.append((name, *cells))
    return markdown(("`alpha_min`, `stop_transmittance`", "time", "image", "gradients"), lines)
