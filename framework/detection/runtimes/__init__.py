"""Runtimes of ONNX and Caffe2 networks."""
