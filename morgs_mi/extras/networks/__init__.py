"""Networks in ONNX files, for flow, masks and measures."""
