"""Report of the entries in a file that a reader does not use."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

_LOG = logging.getLogger(__name__)
# Names in a message.
_MAX_LISTED = 10


def warn_unread(path: Path, names: Iterable[str]) -> None:
    """Name in one warning the entries of a file that are not understood, if there are any; a name
    may occur often.
    """
    unread = sorted(set(names))
    if not unread:
        return
    rest = f" and {len(unread) - _MAX_LISTED} others" if len(unread) > _MAX_LISTED else ""
    _LOG.warning(
        "%s: not understood and not used: %s%s.", path, ", ".join(unread[:_MAX_LISTED]), rest
    )
