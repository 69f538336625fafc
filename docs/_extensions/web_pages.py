"""Web pages of the streams in docs/gallery, written beside the pages of the documentation."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx


def write_pages(app: Sphinx, error: Exception | None) -> None:
    """Write gallery/NAME.html for every gallery/NAME.morgs."""
    if error is not None or app.builder.format != "html":
        return
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from morgs_mi.playback.export.web import write_web_page
    from morgs_mi.playback.streams import open_stream

    for stream in Path(app.srcdir, "gallery").glob("*.morgs"):
        page = Path(app.outdir, "gallery", f"{stream.stem}.html")
        page.parent.mkdir(exist_ok=True)
        write_web_page(open_stream(stream), page)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("build-finished", write_pages)
    return {"parallel_read_safe": True}
