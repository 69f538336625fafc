"""The figures of a benchmark as JSON, with the commit, the date, the machine and the versions that
they belong to.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from morgs_mi.platform.environment import machine, versions
from morgs_mi.platform.files import write_json


@dataclass(frozen=True)
class Output:
    """Base of a benchmark's options."""

    json: Path | None = None
    """JSON file for the figures, which are also printed."""

    def write(self, figures: Mapping[str, Any], unprinted: Collection[str] = ()) -> None:
        """Print the figures and write them to the file.

        Args:
            figures: by name.
            unprinted: names of figures that only the file has.
        """
        result = {
            **figures,
            "commit": commit(),
            "date": date.today().isoformat(),
            "machine": machine(),
            "versions": versions(),
        }
        print(
            json.dumps(
                {name: value for name, value in result.items() if name not in unprinted}, indent=2
            )
        )
        if self.json is not None:
            write_json(self.json, result)


def commit() -> str:
    """Return the commit of this checkout, with -dirty if files differ from it; empty outside of a
    repository.
    """
    command = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        process = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return process.stdout.strip()
