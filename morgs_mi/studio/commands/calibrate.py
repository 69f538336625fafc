"""`morgs-mi calibrate`: camera poses from images."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from morgs_mi.cli.console import print_result, print_table, print_warning, progress
from morgs_mi.cli.settings import Flag, Without
from morgs_mi.studio.calibration.calibrate import CalibrateConfig
from morgs_mi.studio.commands.info import advice_lines, check_cells, check_table


@dataclass(frozen=True)
class Calibrate:
    """Calibrate the cameras of a folder of clips with COLMAP, and write FOLDER/sparse/0."""

    folder: Positional[Path]
    """Folder of videos, or of one folder of images per camera."""
    config: Annotated[CalibrateConfig, arg(name=""), FlagCreatePairsOff] = field(
        default_factory=CalibrateConfig
    )
    without: Without = ()
    """Cameras that are left out, by name."""
    overwrite: Flag = False
    """Replace an earlier model in FOLDER/sparse."""

    def run(self) -> None:
        from morgs_mi.studio.calibration.calibrate import calibrate

        with progress() as report:
            result = calibrate(
                self.folder,
                self.config,
                self.overwrite,
                lambda *stage: report(*stage),
                self.without,
            )
        table = check_table(str(result.model), ("camera", "points", "error, px", "pose"))
        for check in result.checks:
            table.add_row(check.name, *check_cells(check))
        print_table(table)
        for line in advice_lines(result.checks):
            print_warning(line)
        points = ", with a principal point for each" if result.principal_points else ""
        print_result(
            f"{result.model}: {len(result.cameras)} cameras, {result.points} points, mean "
            f"reprojection error {result.error:.2f} px, by {result.mapper} mapping{points}; scale "
            "and up direction of its world are arbitrary."
        )
