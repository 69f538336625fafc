"""Programs in processes of their own."""

import subprocess
import sys


def run_script(script, *arguments, **options):
    """Return the result of a Python program, with what it prints as text."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, **options)
