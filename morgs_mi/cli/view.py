"""`morgs-mi view`: a stream in the browser."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result
from morgs_mi.viewer.viewer import ViewerConfig

__all__ = ["View"]


@dataclass(frozen=True)
class View:
    """View a stream in the browser, even while it is being fitted."""

    out: Positional[Path]
    """Folder of a fit, or a stream file."""
    open_browser: bool = True
    """Open the page in this machine's browser."""
    config: Annotated[ViewerConfig, arg(name="")] = field(default_factory=ViewerConfig)

    def run(self) -> None:
        from morgs_mi.viewer.viewer import Viewer

        try:
            viewer = Viewer(self.out, self.config)
        except ImportError as error:
            raise ValueError(str(error)) from error
        print_result(f"{viewer.url} (Ctrl-C to stop)")
        if self.open_browser:
            webbrowser.open(viewer.url)
        viewer.run()
