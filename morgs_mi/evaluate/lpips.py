"""LPIPS with a user-supplied ONNX network, run by OpenCV; the package includes neither weights nor PyTorch.

Zhang, Isola, Efros, Shechtman and Wang, "The unreasonable effectiveness of deep features as a perceptual metric",
CVPR 2018. With PyTorch and the authors' package ``lpips`` installed, this writes the file:

    import lpips, torch
    net, x = lpips.LPIPS(net="alex", spatial=True).eval(), torch.zeros(1, 3, HEIGHT, WIDTH)
    torch.onnx.export(net, (x, x), "lpips_alex.onnx", input_names=["in0", "in1"], dynamo=False)

for images of one size. Whether a network accepts other sizes depends on its export.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from morgs_mi.evaluate.metrics import unit_pair

__all__ = ["Lpips"]


class Lpips:
    """Perceptual distance: 0 for equal images, larger for larger differences.

    The network has two inputs, ``in0`` and ``in1``, RGB [1, 3, H, W] from -1 to 1, and one output: a distance per
    pixel [1, 1, H, W] (``spatial=True``), or a single number without regions.

    Args:
        path: ONNX file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: OpenCV cannot read the file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise FileNotFoundError(f"{path}: expected an LPIPS network as ONNX, found none; check the path.")
        try:
            self._net = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise ValueError(
                f"{path}: expected an ONNX network, got a file that OpenCV cannot read ({_reason(error)}); "
                "export it again."
            ) from None

    def distance_map(self, image: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Return the distance per pixel [H, W], or of the whole image [1, 1] if the network returns a single number.

        Args:
            image: display-referred RGB [H, W, 3], float in [0, 1] or uint8.
            truth: likewise.

        Raises:
            ValueError: the sizes differ, or the network does not accept images of that size, has other inputs or
                another output.
        """
        pair = unit_pair("Lpips", image, truth)
        H, W = pair[0].shape[:2]
        try:
            for name, array in zip(("in0", "in1"), pair, strict=True):
                self._net.setInput(np.ascontiguousarray(2 * array.transpose(2, 0, 1)[None] - 1, np.float32), name)
            distance = np.asarray(self._net.forward())
        except cv2.error as error:
            raise ValueError(
                f"{self.path}: expected a network with inputs in0 and in1 that take {W}x{H} pixels, got one that does "
                f"not ({_reason(error)}); export it for that size."
            ) from None
        if distance.size not in (1, H * W):
            raise ValueError(
                f"{self.path}: expected one distance, or one for each of {W}x{H} pixels, got {list(distance.shape)}; "
                "export the network as the documentation of morgs_mi.evaluate.lpips shows."
            )
        return distance.reshape((H, W) if distance.size > 1 else (1, 1))


def _reason(error: cv2.error) -> str:
    return (str(error.err or error).strip().splitlines() or ["no reason given"])[0]
