"""`morgs-mi view`: a stream in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result
from morgs_mi.cli.settings import optional, options
from morgs_mi.cli.streams import DropInvalid, opened


@options
class View:
    """View a stream or a file of Gaussians in the browser; a stream even during its fit."""

    source: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians: .ply, .compressed.ply or .splat."""
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address of the server; the default serves this machine only, 0.0.0.0 all machines that have
    the link.
    """
    port: int = 0
    """Port of the server; 0: a free one."""
    browser: bool = True
    """Open the page in the browser of this machine."""
    follow: bool = False
    """Begin at the newest frame."""
    capture: Annotated[Path | None, optional("FOLDER")] = None
    """Folder of the capture with the recorded images; by default the one that was fitted."""
    drop_invalid: DropInvalid = False

    def run(self) -> None:
        from morgs_mi.playback.viewer.server import Viewer

        viewer = Viewer(opened(self.source, self.drop_invalid), self.host, self.port, self.capture)
        print_result(f"{viewer.url} (Ctrl-C to stop)")
        if viewer.is_public:
            print_result(
                "Other machines open the same link with the address of this machine in digits."
            )
        if self.browser:
            webbrowser.open(viewer.url + ("#follow" if self.follow else ""))
        viewer.run()
