"""Web server that shows a stream, even while it is written, in the page of `export.web`."""
