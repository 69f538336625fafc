"""Draw the same Gaussians by `gaussian_splat` and by Mitsuba's `volprim_rf_basic`, for the page
docs/mitsuba.md.

    python -m benchmarks.ewa

The Gaussians are the first frame of a small synthetic clip. The picture states the PSNR between the
two images.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import mitsuba as mi
import numpy as np

import morgs_mi
from morgs_mi.core.color_space import encode_light
from morgs_mi.evaluate.metrics import psnr
from morgs_mi.playback.visualise import to_uint8

_OUT = Path("docs/pictures/ewa.jpg")
_RAYS = 64  # per pixel
_ERROR_GAIN = 10
_JPEG_QUALITY = 90


def main() -> None:
    """Fit the Gaussians and write the picture."""
    mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as folder:
        clip = morgs_mi.SynthConfig(cameras=9, frames=2, width=320, height=240)
        morgs_mi.synthesize("spheres", Path(folder, "clip"), clip)
        capture = morgs_mi.load_capture(Path(folder, "clip"))
        fit = morgs_mi.FitConfig(num_gaussians=6000, first_frame_steps=600)
        loop = morgs_mi.StreamLoop.of(capture, morgs_mi.StreamConfig(fit=fit))
        loop.push(next(capture.frames()).train)
    assert loop.gaussians is not None
    images = rendered(loop.gaussians, capture.cameras[capture.reference_view], _RAYS)
    print(f"{_OUT}: {write_picture(_OUT, images):.1f} dB")


def write_picture(path: Path, images: dict[str, np.ndarray]) -> float:
    """Write the images of the two integrators and their difference, and return their PSNR in dB."""
    decibels = psnr(images["gaussian_splat"], images["volprim_rf_basic"])
    difference = np.abs(images["gaussian_splat"] - images["volprim_rf_basic"]) * _ERROR_GAIN
    panels = {**images, f"difference x {_ERROR_GAIN}, PSNR {decibels:.1f} dB": difference}
    picture = np.concatenate(
        [labelled(to_uint8(image), text) for text, image in panels.items()], axis=1
    )
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return decibels


def rendered(
    gaussians: morgs_mi.Gaussians, camera: morgs_mi.Camera, spp: int
) -> dict[str, np.ndarray]:
    """Return display-referred images [H, W, 3] of the two integrators, by their names."""
    shape = morgs_mi.ellipsoids(gaussians)
    scene = mi.load_dict({"type": "scene", "gaussians": shape, "sensor": camera.square().sensor()})
    images = {}
    for name in ("gaussian_splat", "volprim_rf_basic"):
        image = np.array(mi.render(scene, integrator=mi.load_dict({"type": name}), spp=spp))[
            ..., :3
        ]
        images[name] = np.clip(encode_light(image), 0, 1)
    return images


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    """Return an image with a line of text above it."""
    header = np.full((20, image.shape[1], 3), 255, np.uint8)
    cv2.putText(header, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([header, image])


if __name__ == "__main__":
    main()
