"""Problems that the images of a frame show: views of one colour, and a cut to another scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from morgs_mi.method.exposure import thumbnail

# px: thumbnails of this width keep the layout of a scene, without noise and the motion between two
# frames.
_WIDTH = 16
# Standard deviation of the thumbnail of an image of one colour, in grey levels.
_PLAIN = 2.0
# Mean of a black image, in grey levels.
_BLACK = 16.0
# Correlation of the thumbnails of successive frames; it is 0.95 and more in recordings, and 0.7 and
# less at cuts.
_SAME_SCENE = 0.8
# Share of a thumbnail that changes by more than some grey levels: a few percent in recordings, half
# of it at cuts. A bright object alone, in fast motion before a dull scene, changes the correlation
# and less of the thumbnail.
_LEAST_CHANGED = 0.4
_CHANGE = 8.0


def image_status(
    names: Sequence[str], previous: Mapping[int, np.ndarray], images: Mapping[int, np.ndarray]
) -> tuple[str, ...]:
    """Return a sentence with advice for each problem of a frame's images.

    Args:
        names: of the views.
        previous: images of the frame before, uint8 [H, W, 3], by view index; empty for the first
            frame.
        images: of this frame, likewise.
    """
    old_thumbnails, thumbnails = (
        {v: thumbnail(image, _WIDTH).astype(np.float64) for v, image in some.items()}
        for some in (previous, images)
    )
    plain = [v for v, image in thumbnails.items() if image.std((0, 1)).max() < _PLAIN]
    views = (v for v in thumbnails.keys() & previous.keys() if v not in plain)
    cuts = [v for v in views if _is_cut(old_thumbnails[v], thumbnails[v])]
    sentences = []
    if plain:
        color = "black" if max(thumbnails[v].mean() for v in plain) < _BLACK else "of one colour"
        sentences.append(
            f"{_list(names, plain)}: the image is {color}; cut such frames off the recording, or "
            "leave the camera out (--exclude)"
        )
    if cuts and 2 * len(cuts) >= len(thumbnails):
        sentences.append(
            "the images show another scene than in the frame before; end the fit before this "
            "frame (--frames), and fit the rest as another recording"
        )
    elif cuts:
        sentences.append(
            f"{_list(names, cuts)}: the image shows something else than in the frame before; if "
            "the camera was moved, or its clip has a cut, leave it out (--exclude)"
        )
    return tuple(sentences)


def _list(names: Sequence[str], views: Sequence[int]) -> str:
    return ", ".join(names[v] or f"view {v}" for v in sorted(views))


def _is_cut(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two thumbnails show different scenes; another exposure, or light after black,
    is no cut.
    """
    if a.std((0, 1)).max() < _PLAIN:
        return False
    a = a - a.mean((0, 1))
    b = b - b.mean((0, 1))
    scale = np.sqrt((a * a).sum() * (b * b).sum())
    change = np.abs(a - b).max(axis=-1) > _CHANGE
    return bool((a * b).sum() < _SAME_SCENE * scale and change.mean() > _LEAST_CHANGED)
