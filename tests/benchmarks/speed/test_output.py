"""Metadata that every benchmark writes beside its figures."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from datetime import date

from benchmarks.speed import output
from benchmarks.speed.output import Output, commit


@dataclass(frozen=True)
class Options(Output):
    pass


def test_output__records_commit_date_machine_and_versions(tmp_path, capsys):
    Options(json=tmp_path / "out.json").write({"error": 0.5, "rows": [1, 2]}, unprinted=["rows"])
    figures = json.loads((tmp_path / "out.json").read_text())
    assert (figures["error"], figures["rows"]) == (0.5, [1, 2])
    assert figures["date"] == date.today().isoformat()
    assert figures["commit"] == commit()
    assert {"machine", "versions"} <= figures.keys()
    assert "rows" not in json.loads(capsys.readouterr().out)


def test_commit__is_empty_outside_of_a_repository(monkeypatch):
    def fail(*args, **options):
        raise subprocess.CalledProcessError(128, "git")

    monkeypatch.setattr(output.subprocess, "run", fail)
    assert commit() == ""
