"""The notebooks run from top to bottom, and stay small enough for a repository."""

import base64
import re
from pathlib import Path

import pytest

nbclient = pytest.importorskip("nbclient", reason="comes with the extra `notebooks`")
nbformat = pytest.importorskip("nbformat", reason="comes with the extra `notebooks`")
pytest.importorskip("matplotlib", reason="comes with the extra `notebooks`")
pytest.importorskip("ipykernel", reason="comes with the extra `notebooks`")

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


LONG_CALLS = {
    "Fitting": "morgs_mi.stream_capture(capture, out, CONFIG, progress=Bar('Fitting').report)",
    "Evaluating": "morgs_mi.evaluate_stream(out, progress=Bar('Evaluating'))",
    "Writing": "write_web_page(stream(), out / 'page.html', progress=Bar('Writing', 2))",
    "Exporting": (
        "write_each(play(stream()), out / 'ply', '.ply', write_ply, [0, 1], Bar('Exporting'))"
    ),
    "Importing": "import_frames([out / 'ply'], out / 'again', progress=Bar('Importing'))",
}
SET_UP = """
from pathlib import Path
from tempfile import TemporaryDirectory
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import morgs_mi
from morgs_mi import ProgressBar as Bar
from morgs_mi.codec.frame_source import play
from morgs_mi.playback.export.clips import write_each
from morgs_mi.playback.export.web import write_web_page
from morgs_mi.extras.imports.import_frames import import_frames
from morgs_mi.io.ply import write_ply
from tests.scenes.changing_splats import rig, splats
from tests.scenes.recording import CONFIG, write_recording
folder = TemporaryDirectory()
out = Path(folder.name) / "out"
capture = morgs_mi.load_capture(write_recording(Path(folder.name) / "capture", 2))
stream = lambda: morgs_mi.open_stream(out)
"""


def shown(cell):
    """Return the output of a cell by MIME type, of several elements the last one."""
    return {kind: data for output in cell.outputs for kind, data in output.get("data", {}).items()}


@pytest.mark.slow
def test_cells__show_images_streams_and_progress():
    cells = [
        SET_UP,
        "morgs_mi.rasterize(splats(), rig()[0])",
        *(f"_ = {call}" for call in LONG_CALLS.values()),
    ]
    notebook = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(cell) for cell in [*cells, "stream()"]]
    )
    client = nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}
    )
    client.execute()
    _, image, *bars, stream = notebook.cells
    assert base64.b64decode(shown(image)["image/png"]).startswith(b"\x89PNG")
    assert "<iframe sandbox=" in shown(stream)["text/html"]
    for title, bar in zip(LONG_CALLS, bars, strict=True):
        match = re.fullmatch(
            r'<div>(\w+)(?:: [\w ]+)? <progress value="([\d.]+)" max="([\d.]+)".*',
            shown(bar)["text/html"],
        )
        assert (match[1], float(match[2])) == (title, float(match[3]))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks__run(path):
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}
    )
    client.execute()  # raises where a cell fails


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_notebooks__are_small_and_show_their_outputs(path):
    assert path.stat().st_size < 300_000
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    assert any(cell.outputs for cell in cells)
    assert not any(output.output_type == "error" for cell in cells for output in cell.outputs)
