"""The fixtures of the tests of the command line."""

from tests.cli.conftest import capture, run, stream

__all__ = ["capture", "run", "stream"]
