"""`morgs-mi view`: a stream in the browser."""

from __future__ import annotations

import signal
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from morgs_mi.cli.console import print_result
from morgs_mi.cli.opening import DropInvalid, most_invalid, print_cameras
from morgs_mi.playback.viewer.viewer import Viewer, ViewerConfig

__all__ = ["View"]


@dataclass(frozen=True)
class View:
    """View a stream or a file of Gaussians in the browser; a stream even while it is being fitted."""

    out: Positional[Path]
    """Folder of a fit, a stream file, or a file of Gaussians: .ply, .compressed.ply or .splat."""
    open_browser: bool = True
    """Open the page in the browser of this machine."""
    drop_invalid: DropInvalid = False
    config: Annotated[ViewerConfig, arg(name="")] = field(default_factory=ViewerConfig)

    def run(self) -> None:
        try:
            viewer = Viewer(self.out, self.config, self._announce, most_invalid(self.drop_invalid))
        except ImportError as error:
            raise ValueError(str(error)) from error
        with _stopped_by_interrupt(viewer.stop):
            viewer.run()

    def _announce(self, viewer: Viewer) -> None:
        """Report the cameras and the address, and open it."""
        print_cameras(viewer.stream)
        print_result(f"{viewer.url} (Ctrl-C to stop)")
        if viewer.is_public:
            print_result(
                "Every machine that can reach this one can open the page, without a password: by the address of this "
                "machine in digits, or by a name passed with --allowed-names."
            )
        if self.open_browser:
            webbrowser.open(viewer.url)


@contextmanager
def _stopped_by_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C or SIGTERM, and raise KeyboardInterrupt only at the end, or at the second signal.

    Raised at once, it can end up in a callback of a library, which ignores it: the viewer would run on.
    """
    interrupted = []

    def handle(*_: object) -> None:
        if interrupted:
            raise KeyboardInterrupt
        interrupted.append(True)
        stop()

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if interrupted:
        raise KeyboardInterrupt
