"""The entry point of the command line prepares the process; `import morgs_mi` changes nothing."""

import os
import subprocess
import sys

import pytest

from tests.scenes.programs import run_script

# Signals that arrive when a module is first imported.
STARTING = """
import builtins, runpy, signal, sys
signal.signal(signal.{number}, signal.SIG_DFL)  # which nohup ignores
load = builtins.__import__

def interrupted(name, *args, **more):
    if name == "{module}":
        signal.raise_signal(signal.{number})
    return load(name, *args, **more)

builtins.__import__ = interrupted
{start}
"""
SCRIPT = "from morgs_mi_command import main; sys.exit(main())"
MODULE = "runpy.run_module('morgs_mi', run_name='__main__')"


@pytest.mark.parametrize(
    ("module", "number", "start"),
    [
        ("numpy", "SIGINT", SCRIPT),
        ("drjit", "SIGTERM", SCRIPT),
        ("tyro", "SIGHUP", SCRIPT),
        ("tyro", "SIGINT", MODULE),
    ],
)
def test_main__ends_quietly_while_libraries_are_imported(module, number, start):
    result = run_script(STARTING.format(module=module, number=number, start=start))
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "Interrupted.\n")


@pytest.mark.parametrize("closed", [0, 1, 2])
def test_main__replaces_a_closed_standard_stream(closed):
    """Otherwise the next file that is opened would be the standard stream of libraries."""
    null = os.stat(os.devnull).st_rdev
    script = (
        "import os, sys, types; module = types.ModuleType('morgs_mi.cli.main')\n"
        f"module.main = lambda: os.fstat({closed}).st_rdev != {null}\n"
        "sys.modules['morgs_mi.cli.main'] = module\n"
        "from morgs_mi_command import main; sys.exit(main())"
    )
    args = [sys.executable, "-c", script]
    assert subprocess.run(args, preexec_fn=lambda: os.close(closed), check=False).returncode == 0


WITHOUT_LLVM = """
import sys, types
module = types.ModuleType("morgs_mi.platform.llvm")
def ensure_llvm():
    raise RuntimeError("Dr.Jit's CPU backend needs LLVM.")
module.ensure_llvm = ensure_llvm
sys.modules["morgs_mi.platform.llvm"] = module
sys.argv = ["/usr/bin/morgs-mi", "demo"]
"""


def test_main__prints_a_sentence_without_llvm():
    result = run_script(f"{WITHOUT_LLVM}\nfrom morgs_mi_command import main; main()")
    assert (result.returncode, result.stderr) == (1, "Dr.Jit's CPU backend needs LLVM.\n")


def test_import__raises_without_llvm_whatever_the_program_is_called():
    code = "try: import morgs_mi\nexcept RuntimeError as error: print(error)"
    result = run_script(f"{WITHOUT_LLVM}\n{code}", check=True)
    assert result.stdout == "Dr.Jit's CPU backend needs LLVM.\n"


def test_import__reads_no_arguments_and_sets_no_signal_handler():
    script = """
import os, signal, sys
def state():
    handlers = [signal.getsignal(number) for number in signal.valid_signals()]
    return handlers, "PYTHONSAFEPATH" in os.environ, sys.stdin, sys.stdout, sys.stderr
before = state()
del sys.argv, sys.orig_argv
import morgs_mi
print(state() == before)
"""
    assert run_script(script, check=True).stdout == "True\n"
