"""Workers without processes."""

from __future__ import annotations

import pickle

from morgs_mi.runs.cluster.executor import Workers


class Here(Workers):
    """A worker that is this process, and gets its tasks as bytes; it dies at a task with a number."""

    place = "here"
    count = 1  # pyright: ignore[reportAssignmentType]

    def __init__(self, dies_at: int = 99) -> None:
        self.left = dies_at

    async def run(self, function, *args):
        self.left -= 1
        if not self.left:
            raise ChildProcessError("it died.")
        function, args = pickle.loads(pickle.dumps((function, args)))
        return function(*args)
