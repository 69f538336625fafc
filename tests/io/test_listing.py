"""Files that operating systems add to folders are no content."""

from morgs_mi.io.listing import is_added, listed

ADDED = (
    "._cam01.mp4",
    ".DS_Store",
    "Thumbs.db",
    "desktop.ini",
    "__MACOSX",
    "@eaDir",
    "$RECYCLE.BIN",
)


def test_listed__leaves_out_what_systems_add_and_hidden_files(tmp_path):
    for name in (*ADDED, ".git", "b.png", "a.png", "frames"):
        (tmp_path / name).touch()
    assert [file.name for file in listed(tmp_path)] == ["a.png", "b.png", "frames"]


def test_is_added__does_not_count_hidden_files_of_users():
    assert all(map(is_added, ADDED))
    assert not any(map(is_added, (".git", ".env", "a.png", "thumbs")))
