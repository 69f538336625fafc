"""Reports on errors of the renderer, the codec and the method.

    python -m benchmarks.reports stability --json out.json
    python -m benchmarks.reports codec CAPTURE... --out out/codec
    python -m benchmarks.reports method CAPTURE... --out out/method

`morgs-mi synth` writes captures with ground truth. The other modules of this folder are reports of
their own: `python -m benchmarks.reports.random_scenes`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from benchmarks.reports import codec, method, stability
from morgs_mi.cli.main import Common, run
from morgs_mi.cli.settings import one_command

SUBJECTS = {
    "stability": stability.Options,
    "codec": codec.Options,
    "method": method.Options,
}


@dataclass(frozen=True)
class Options(Common):
    """Measure error and run time of a part of the package."""

    command: Annotated[Any, one_command(SUBJECTS)] = tyro.MISSING


def main(args: Sequence[str] | None = None) -> int:
    """Run a report and return the exit status; `args` default to the process's."""
    return run(Options, "python -m benchmarks.reports", args)


if __name__ == "__main__":
    sys.exit(main())
