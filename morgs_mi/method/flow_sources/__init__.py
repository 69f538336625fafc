"""Sources of optical flow: OpenCV, files, ONNX networks."""
