"""Check that a tag, such as v0.2.0, the version of the package, the citation and the change log
agree.
"""

from __future__ import annotations

import re
import sys
import tomllib
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parents[1]


def problems(tag: str) -> list[str]:
    """Return a sentence for each file that does not agree with a tag."""
    version = tag.removeprefix("v")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = re.findall(
        r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    log = re.findall(
        r"^## \[(\d.*)\] - (\S+)$",
        (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        re.MULTILINE,
    )
    newest, day = log[0]
    versions = {
        "pyproject.toml": project["version"],
        "CITATION.cff": citation[0],
        "CHANGELOG.md": newest,
    }
    wrong = [
        f"{name}: expected version {version}, got {value}."
        for name, value in versions.items()
        if value != version
    ]
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", day) or day > date.today().isoformat():
        wrong.append(f"CHANGELOG.md: expected the day of the release, got {day}.")
    if not {"Source", "Issues"} <= project["urls"].keys():
        wrong.append(
            "pyproject.toml: expected the addresses Source and Issues in [project.urls]; add them."
        )
    return wrong


if __name__ == "__main__":
    sys.exit("\n".join(problems(sys.argv[1])) or 0)
