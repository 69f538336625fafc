"""The choice of libLLVM: the user's if it is usable, otherwise the newest; an error message instead
of a crash.
"""

import sys
from pathlib import Path

import pytest

from morgs_mi.platform import llvm
from tests.scenes.programs import run_script

linux = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="the search is for Linux only"
)
pytestmark = linux


@pytest.fixture
def libraries(tmp_path):
    """Return a function that puts empty files of the given names into a folder."""

    def make(*names):
        for name in names:
            (tmp_path / name).touch()
        return [tmp_path]

    return make


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM-14.0.6.so", 14),
        ("libLLVM.so.22.1", 22),
        ("libLLVM.so", 0),
        ("libLLVMPolly.so", 0),
        ("libLLVM.so.21.0git", 21),
    ],
)
def test_llvm_major__reads_the_file_name(tmp_path, name, major):
    assert llvm.llvm_major(tmp_path / name) == major


def test_llvm_major__follows_links(libraries, tmp_path):
    libraries("libLLVM.so.20.1")
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.20.1")
    assert llvm.llvm_major(tmp_path / "libLLVM.so") == 20


def test_choose_llvm__takes_the_users_choice_if_it_is_usable_or_else_the_newest(
    libraries, monkeypatch
):
    folders = libraries(
        "libLLVM-9.so.1", "libLLVM.so.19.1", "libLLVM.so.22.1", "libLLVM-15.so.1", "libLLVMx.so"
    )
    monkeypatch.setattr(llvm, "search_folders", lambda: folders)
    assert [llvm.llvm_major(path) for path in llvm.find_llvm()] == [22, 19, 15, 9]
    newest = folders[0] / "libLLVM.so.22.1"
    good = folders[0] / "libLLVM.so.19.1"
    assert llvm.choose_llvm() == (newest, "")
    assert llvm.choose_llvm(str(good)) == (good, "")
    path, problem = llvm.choose_llvm(str(folders[0] / "libLLVM-15.so.1"))
    assert path == newest
    assert "libLLVM-15" in problem
    assert "libLLVM.so.22.1 is used instead" in problem
    for usable in (newest, good):
        usable.unlink()
    path, problem = llvm.choose_llvm()
    assert path is None
    assert "libLLVM-15.so.1" in problem
    assert "apt-get install libllvm" in problem


def test_ensure_llvm__raises_without_cuda_and_warns_with_it(monkeypatch):
    monkeypatch.setattr(llvm, "find_llvm", lambda: [])
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    with pytest.raises(RuntimeError, match="LLVM 17 or newer"):
        llvm.ensure_llvm()
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    with pytest.warns(RuntimeWarning, match="LLVM 17 or newer"):
        llvm.ensure_llvm()
    # The unusable path keeps Dr.Jit from loading an old library by itself.
    assert not Path(llvm.os.environ[llvm.VARIABLE]).exists()


def test_ensure_llvm__replaces_an_unusable_library_on_import(tmp_path):
    """A library that Dr.Jit cannot use is replaced, with a warning, before Dr.Jit loads it."""
    bad = tmp_path / "libLLVM-15.so.1"
    bad.touch()
    code = (
        "import morgs_mi; import drjit as dr; from drjit.llvm import Float; "
        "print(dr.minimum(Float(1, 3), 2))"
    )
    environment = llvm.os.environ | {llvm.VARIABLE: str(bad)}
    run = run_script(code, env=environment)
    assert run.returncode == 0, run.stderr
    assert run.stdout.strip() == "[1, 2]"
    assert "RuntimeWarning" in run.stderr
