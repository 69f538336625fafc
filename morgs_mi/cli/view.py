"""`morgs-mi view`: a stream in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result
from morgs_mi.cli.settings import optional, options
from morgs_mi.cli.streams import DropInvalid, PageCamera, opened, print_view, with_first_camera


@options
class ViewStream:
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
    camera: PageCamera = None
    capture: Annotated[Path | None, optional("FOLDER")] = None
    """Folder of the capture with the recorded images; by default the one that was fitted."""
    drop_invalid: DropInvalid = False

    def run(self) -> None:
        from morgs_mi.playback.viewer.server import Viewer

        stream = opened(self.source, self.drop_invalid)
        wishes = ["follow"] if self.follow else []
        name = with_first_camera(stream, self.camera)
        if name is not None:
            wishes.append(f"camera={quote(name)}")
        viewer = Viewer(stream, self.host, self.port, self.capture)
        url = urlsplit(viewer.url)._replace(fragment="&".join(wishes)).geturl()
        print_result(f"{url} (Ctrl-C to stop)")
        print_view(stream, self.camera)
        if viewer.is_public:
            print_result(
                "Other machines open the same link with the address of this machine in digits."
            )
        if self.browser:
            webbrowser.open(url)
        viewer.run()
