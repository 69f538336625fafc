"""Helpers of the tests of commands: an interruption, and the refusal of a command."""


def interrupt(*_, **__):
    raise KeyboardInterrupt


def assert_refused(result, *parts):
    """Assert the exit status 1 and one sentence with all `parts`."""
    status, _, error = result
    assert status == 1
    assert_one_sentence(error, *parts)


def assert_one_sentence(error, *parts):
    lines = [line for line in error.splitlines() if line.strip() and "━" not in line]
    assert len(lines) == 1, error
    assert "Traceback" not in error
    for part in parts:
        assert part in lines[0]
