"""Check an installed package outside of a checkout: imports, data files, an image, a fit of two
frames, a web page.

Run it as `python -I tools/check_installed.py`; with `--image`, only an image of a file of Gaussians
is rendered.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from importlib.metadata import files, version
from importlib.resources import files as resources
from pathlib import Path

SPLATS = 200
QUICK = ("--num-gaussians", "300", "--first-frame-steps", "20", "--epochs", "1")


def command(folder: Path, *args: str) -> str:
    """Return the output of `morgs-mi` with arguments."""
    done = subprocess.run(
        [sys.executable, "-I", "-m", "morgs_mi", *args], cwd=folder, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(
            f"morgs-mi {' '.join(args)}: status {done.returncode}\n{done.stdout}{done.stderr}"
        )
    print("morgs-mi", *args)
    return done.stdout


def write_splats(path: Path) -> None:
    """Write Gaussians as the text of a PLY file."""
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
    ]
    names += [f"rot_{i}" for i in range(4)]
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {SPLATS}",
        *(f"property float {name}" for name in names),
    ]
    rows = [
        f"{i % 10} {i // 10 % 5} {i // 50} {i % 3 - 1} {i % 5 / 2 - 1} 0.5 2 -1 -1.5 -1 1 0 0 0"
        for i in range(SPLATS)
    ]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")


def check_files() -> None:
    """Check that the package is installed, not a checkout, with its data files."""
    import morgs_mi

    place = Path(morgs_mi.__file__).parent
    if (place.parent / "pyproject.toml").exists():
        raise SystemExit(
            f"{place}: expected an installed package, got a checkout; run this from another folder."
        )
    for name in ("player.html", "player.js", "NOTICE"):
        assert (resources("morgs_mi") / "playback" / "export" / "web_player" / name).is_file(), name
    scenes = {file.stem for file in files("morgs-mi") or () if file.match("morgs_mi/scenes/*.py")}
    assert {"arm", "spheres", "random"} <= scenes, scenes
    assert (place / "py.typed").is_file()


def check_image(folder: Path) -> None:
    """Render a file of Gaussians into a PNG file that is not black."""
    write_splats(folder / "scene.ply")
    command(folder, "render", "scene.ply", "image.png", "--width", "320")
    import cv2

    image = cv2.imread(str(folder / "image.png"))
    assert image is not None
    assert image.shape == (180, 320, 3), image.shape
    assert image.mean() > 5


def check_fit(folder: Path) -> None:
    """Fit two frames of a synthetic clip, render and export them."""
    size = ("--cameras", "4", "--frames", "2", "--width", "96", "--height", "72", "--spp", "4")
    command(folder, "synth", "spheres", "clip", *size)
    command(folder, "fit", "clip", "out", *QUICK)
    command(folder, "render", "out", "out.mp4", "--camera", "cam00")
    command(folder, "export", "web", "out", "page.html")
    assert (folder / "page.html").stat().st_size > 500_000
    assert (folder / "out.mp4").stat().st_size > 0


def main() -> None:
    """Run the checks."""
    check_files()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        assert command(folder, "--version").strip() == f"morgs-mi {version('morgs-mi')}"
        check_image(folder)
        if "--image" not in sys.argv[1:]:
            check_fit(folder)
    print(f"morgs-mi {version('morgs-mi')} works where it is installed.")


if __name__ == "__main__":
    main()
