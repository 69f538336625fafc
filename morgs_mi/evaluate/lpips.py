"""LPIPS with a user-supplied ONNX network, run by `onnxruntime`; the package has neither weights
nor PyTorch.

Zhang, Isola, Efros, Shechtman and Wang, "The unreasonable effectiveness of deep features as a
perceptual metric", CVPR 2018. With PyTorch and the authors' package ``lpips`` installed, this
writes the file:

    import lpips, torch
    net, x = lpips.LPIPS(net="alex", spatial=True).eval(), torch.zeros(1, 3, HEIGHT, WIDTH)
    torch.onnx.export(net, (x, x), "lpips_alex.onnx", input_names=["in0", "in1"], dynamo=False)

for images of one size. Whether a network accepts other sizes depends on its export.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morgs_mi.evaluate.metrics import unit_pair
from morgs_mi.io.onnx_file import OnnxNetwork
from morgs_mi.platform.checks import require

_INPUTS = ("in0", "in1")
_ADVICE = "export the network as the documentation of morgs_mi.evaluate.lpips shows"


class Lpips:
    """Perceptual distance: 0 for equal images, larger for larger differences.

    The network has two inputs, ``in0`` and ``in1``, RGB [1, 3, H, W] from -1 to 1, and one output:
    a distance per pixel [1, 1, H, W] (``spatial=True``).

    Args:
        path: ONNX file.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: `onnxruntime` is not installed or cannot load the file, or the network has other
            inputs.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._network = OnnxNetwork(path)
        names = self._network.inputs
        require(
            {*names} == {*_INPUTS},
            path,
            f"expected a network with inputs {' and '.join(_INPUTS)}",
            ", ".join(names),
            _ADVICE,
        )

    def distance_map(self, image: np.ndarray, truth: np.ndarray) -> np.ndarray:
        """Return the distance per pixel [H, W].

        Args:
            image: display-referred RGB [H, W, 3], float in [0, 1] or uint8.
            truth: likewise.

        Raises:
            ValueError: the sizes differ, or the network does not accept images of that size, has
                another output, or returns NaN or infinity.
        """
        image, truth = unit_pair("Lpips", image, truth)
        H, W = image.shape[:2]
        inputs = {"in0": _network_input(image), "in1": _network_input(truth)}
        distance = next(iter(self._network.run(inputs).values()))
        require(
            distance.size == H * W,
            self.path,
            f"expected a distance for each of {W}x{H} pixels",
            list(distance.shape),
            _ADVICE,
        )
        return distance.reshape(H, W)


def _network_input(image: np.ndarray) -> np.ndarray:
    """Return an image [H, W, 3] of 1 as the network takes it, [1, 3, H, W] from -1 to 1."""
    return np.ascontiguousarray(2 * image.transpose(2, 0, 1)[None] - 1, np.float32)
