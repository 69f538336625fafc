"""The viewer without its optional dependency."""

from __future__ import annotations

import sys

from morgs_mi import cli
from tests.scenes.changing_splats import write_stream


def test_viewer__without_viser_explains_how_to_install_it(tmp_path, monkeypatch, capsys):
    write_stream(tmp_path / "stream.morgs", 1)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main(["view", str(tmp_path)]) == 1
    assert "install it with pip install 'morgs-mi[viewer]'" in capsys.readouterr().err
