"""Networks for flow and masks in ONNX files."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(
        __name__,
        "flow sources",
        {
            "onnx:FILE": "flow_network:onnx",
            "onnx-unit:FILE": "flow_network:onnx_unit",
            "onnx-signed:FILE": "flow_network:onnx_signed",
        },
    )
    enter(__name__, "mask refiners", {"sam2:ENCODER.onnx,DECODER.onnx": "sam2:sam2"})
