"""Runtimes of networks: ONNX and Caffe2."""
