"""Networks in ONNX files, for flow and masks."""
