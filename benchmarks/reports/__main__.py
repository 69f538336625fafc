"""Reports on error and run time of the renderer, the codec and the method.

    python -m benchmarks.reports renderer --json out.json
    python -m benchmarks.reports codec CAPTURE... --out out/codec
    python -m benchmarks.reports method CAPTURE... --out out/method --workers 2

`morgs-mi synth` writes captures with ground truth. The other modules of this folder are reports of their own:
`python -m benchmarks.reports.random_scenes`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro
from tyro.conf import arg

from benchmarks.reports import codec, method, renderer
from morgs_mi.cli import Common, run

Subject = (
    Annotated[renderer.Options, tyro.conf.subcommand("renderer")]
    | Annotated[codec.Options, tyro.conf.subcommand("codec")]
    | Annotated[method.Options, tyro.conf.subcommand("method")]
)


@dataclass(frozen=True)
class Options(Common):
    """Measure error and run time of a part of the package."""

    command: Annotated[Subject, arg(name="")] = tyro.MISSING


def main(args: Sequence[str] | None = None) -> int:
    """Run a report and return the exit status; `args` default to the process's."""
    return run(Options, "python -m benchmarks.reports", args)


if __name__ == "__main__":
    sys.exit(main())
