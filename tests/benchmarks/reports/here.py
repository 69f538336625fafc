"""Workers without processes."""

from __future__ import annotations

from morgs_mi.cluster.executor import Workers


class Here(Workers):
    """A worker that is this process; it dies at a task with a number."""

    place, count = "here", 1

    def __init__(self, dies_at: int = 99) -> None:
        self.left = dies_at

    async def run(self, function, *args):
        self.left -= 1
        if not self.left:
            raise ChildProcessError("it died.")
        return function(*args)
