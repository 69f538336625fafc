"""Helpers of the tests of commands: an interruption, and the refusal of a command."""

from __future__ import annotations


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def assert_refused(result: tuple[int, str, str], *parts: str) -> None:
    """Assert the exit status 1 and one sentence with all `parts`."""
    status, _, error = result
    assert status == 1
    assert_one_sentence(error, *parts)


def assert_one_sentence(error: str, *parts: str) -> None:
    lines = [line for line in error.splitlines() if line.strip() and "━" not in line]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    for part in parts:
        assert part in lines[0]
