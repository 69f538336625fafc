"""Report of the entries in a file that a reader does not use."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

from morgs_mi.core.checks import few

_LOG = logging.getLogger(__name__)


def warn_unread(path: Path, names: Iterable[str]) -> None:
    """Name in one warning the entries of a file that are not understood, if there are any; a name
    may occur often.
    """
    if unread := sorted(set(names)):
        _LOG.warning("%s: not understood and not used: %s.", path, few(unread))
