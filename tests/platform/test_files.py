"""Atomic creation of files and folders, and locked folders."""

import json
import os
from pathlib import Path

import pytest

from morgs_mi.platform.files import atomic_folder, atomic_path, locked_folder, write_json
from tests.scenes.programs import run_script


def tree(path):
    """Return the content of every file below `path` by its name, hidden ones too, and None for
    folders.
    """
    return {
        str(p.relative_to(path)): p.read_bytes() if p.is_file() else None
        for p in sorted(path.rglob("*"))
    }


def write(partial, kind, text="new"):
    """Write a file, or a folder with a file in it."""
    if kind == "folder":
        partial.mkdir()
    (partial / "a" if kind == "folder" else partial).write_text(text)


@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("old", [False, True])
def test_atomic_path__appears_at_the_end_and_replaces_the_old(tmp_path, kind, old):
    if old:
        write(tmp_path / "x", kind, "old")
    old_tree = tree(tmp_path)
    with atomic_path(tmp_path / "x", "test()") as partial:
        write(partial, kind)
        assert {
            name: text for name, text in tree(tmp_path).items() if not name.startswith(".")
        } == old_tree
    assert tree(tmp_path) == ({"x": b"new"} if kind == "file" else {"x": None, "x/a": b"new"})


@pytest.mark.parametrize(
    ("kind", "old", "error"),
    [
        ("file", True, KeyboardInterrupt("stop")),
        ("folder", True, ValueError("bad")),
        ("folder", False, OSError(28, "No space left")),
    ],
)
def test_atomic_path__is_unchanged_after_an_error_in_the_body(tmp_path, kind, old, error):
    if old:
        write(tmp_path / "x", kind, "old")
    old_tree = tree(tmp_path)

    def fail():
        with atomic_path(tmp_path / "x", "test()") as partial:
            write(partial, kind)
            raise error

    message = r"^test\(\): cannot write .*/x: No space left; check .* disk has room\.$"
    with pytest.raises(type(error), match=message if isinstance(error, OSError) else str(error)):
        fail()
    assert tree(tmp_path) == old_tree


@pytest.mark.parametrize("case", ["a file", "a folder", "missing"])
def test_atomic_path__reports_a_folder_that_is_not_writable(tmp_path, case):
    folder = tmp_path / "folder"
    if case == "a file":
        folder.touch()
    elif case == "a folder":
        (folder / "x").mkdir(parents=True)
    old_tree = tree(tmp_path)
    with (
        pytest.raises(OSError, match=rf"test\(\): cannot write {folder}/x: "),
        atomic_path(folder / "x", "test()") as partial,
    ):
        partial.write_text("new")
    assert tree(tmp_path) == old_tree


def test_atomic_path__replaces_no_device_and_no_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileExistsError, match=r"test\(\): .*/pipe is a device or a pipe"):
        atomic_path(tmp_path / "pipe", "test()").__enter__()
    assert (tmp_path / "pipe").is_fifo()


def test_atomic_path__restores_the_old_folder_after_a_failed_swap(tmp_path, monkeypatch):
    write(tmp_path / "x", "folder", "old")
    old_tree = tree(tmp_path)

    def failing(*_):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Path, "replace", failing)
    with (
        pytest.raises(OSError, match="Input/output error"),
        atomic_path(tmp_path / "x", "test()") as partial,
    ):
        write(partial, "folder")
    assert tree(tmp_path) == old_tree


def test_atomic_folder__removes_partial_output_of_a_killed_process_of_its_number(tmp_path):
    """Another process may still write its own."""
    write(tmp_path / f".partial-{os.getpid()}-x", "folder", "half")
    others = {f".partial-{os.getppid()}-x": b"", f".partial-{os.getpid()}-y-x": b""}
    for name in others:
        (tmp_path / name).touch()
    with atomic_folder(tmp_path / "x", "test()") as partial:
        (partial / "b").touch()
    assert tree(tmp_path) == others | {"x": None, "x/b": b""}


def test_write_json__follows_a_link(tmp_path):
    (tmp_path / "link.json").symlink_to(tmp_path / "x.json")
    write_json(tmp_path / "link.json", {})
    assert (tmp_path / "link.json").is_symlink()
    assert (tmp_path / "x.json").read_text() == "{}\n"


def test_atomic_folder__replaces_nothing_not_even_a_folder_created_meanwhile(tmp_path):
    write(tmp_path / "x", "folder", "old")
    with (
        pytest.raises(
            FileExistsError, match="x: expected a new folder, got one that exists; remove it first"
        ),
        atomic_folder(tmp_path / "x", "test()"),
    ):
        pass
    with pytest.raises(OSError, match=r"y: .*not empty"), atomic_folder(tmp_path / "y", "test()"):
        write(tmp_path / "y", "folder", "theirs")
    assert tree(tmp_path) == {"x": None, "x/a": b"old", "y": None, "y/a": b"theirs"}


def test_write_json__writes_null_for_infinity_and_nan(tmp_path):
    write_json(
        tmp_path / "new" / "a.json", {"psnr": [float("inf"), 1.0], "deep": {"nan": float("nan")}}
    )
    assert json.loads((tmp_path / "new" / "a.json").read_text()) == {
        "psnr": [None, 1.0],
        "deep": {"nan": None},
    }
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"cannot write .*b.json"):
        write_json(tmp_path / "file" / "b.json", {})


def test_locked_folder__refuses_a_second_writer_until_the_first_has_ended(tmp_path):
    out = tmp_path / "new" / "out"
    (tmp_path / "link").symlink_to(out)
    with locked_folder(out, "test()"):
        for same in (out, tmp_path / "link"):
            with pytest.raises(
                BlockingIOError, match=f"{same}: .* another process is writing; wait"
            ):
                locked_folder(same, "test()").__enter__()
        (out / "a").write_text("whole")
    with locked_folder(out, "test()"):
        pass
    assert tree(tmp_path / "new") == {"out": None, "out/a": b"whole"}


def test_locked_folder__is_free_after_its_writer_was_killed(tmp_path):
    script = (
        "import os, sys; from morgs_mi.platform.files import locked_folder\n"
        "with locked_folder(sys.argv[1], 'test()'): os.kill(os.getpid(), 9)\n"
    )
    assert run_script(script, str(tmp_path)).returncode == -9
    assert len(tree(tmp_path)) == 1
    with locked_folder(tmp_path, "test()"):
        pass
    assert not tree(tmp_path)


def test_locked_folder__leaves_no_empty_folder(tmp_path):
    with locked_folder(tmp_path / "new" / "out", "test()"):
        pass
    assert not tree(tmp_path)


@pytest.mark.parametrize(
    ("folder", "sentence"),
    [
        ("file", "/file is a file; name a folder"),
        ("file/out", r"^test\(\): cannot write into .*/file/out: Not a directory; check"),
        ("/sys/out", r"^test\(\): cannot write into /sys/out: [^:\[]*; check"),
    ],
)
def test_locked_folder__reports_a_folder_that_cannot_be_written(tmp_path, folder, sentence):
    """/sys accepts no new files, even from root."""
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=sentence):
        locked_folder(tmp_path / folder, "test()").__enter__()
    assert tree(tmp_path) == {"file": b""}
