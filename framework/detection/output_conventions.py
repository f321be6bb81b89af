"""Conversion of network outputs to boxes x1 y1 x2 y2, classes, scores and masks.

Sources:

- TensorFlow's object detection API (`exporter_main_v2.py`): detection_boxes (1, K, 4) y1 x1 y2 x2 in 0..1;
  detection_classes, detection_scores (1, K); num_detections; other outputs before suppression.
- MMDeploy (docs/en/04-supported-codebases/mmdet.md): dets (1, K, 5) x1 y1 x2 y2 score in px; labels (1, K); masks
  (1, K, h, w).
- YOLOv6, YOLOv7 and YOLOv9 with `--end2end`, after TensorRT's EfficientNMS: num_dets (1, 1); det_boxes (1, K, 4) x1 y1
  x2 y2 in px; det_scores, det_classes (1, K).
"""

from __future__ import annotations

from framework.detection.runtimes.onnx_network import Outputs

TENSORFLOW_NAMES = frozenset({"detection_boxes", "detection_classes", "detection_scores"})
YOLO_NAMES = frozenset({"det_boxes", "det_classes", "det_scores"})
TENSORFLOW_MASKS = "detection_masks"
HIDDEN = "hidden_state"  # part of the names of additional outputs of transformers
SCORES = "dets_scores"  # name of the scores that are split from the boxes of MMDeploy


def standard_outputs(outputs: Outputs) -> Outputs:
    """Return the boxes x1 y1 x2 y2, classes, scores and masks of a network, without other outputs."""
    names = {base_name(name) for name in outputs}
    if names >= TENSORFLOW_NAMES:
        kept = {
            name: array for name, array in outputs.items() if base_name(name) in {*TENSORFLOW_NAMES, TENSORFLOW_MASKS}
        }
        return {
            name: array[..., [1, 0, 3, 2]] if base_name(name) == "detection_boxes" else array
            for name, array in kept.items()
        }
    standard: Outputs = {}
    for name, array in outputs.items():
        if base_name(name) == "dets" and array.ndim > 1 and array.shape[-1] == 5:
            standard |= {name: array[..., :4], SCORES: array[..., 4]}
        elif HIDDEN not in name and not ("num" in base_name(name) and array.size == 1):
            standard[name] = array
    return standard


def base_name(name: str) -> str:
    """Return the name of an output in lower case, without the index of TensorFlow and the instance of Detectron2.

    Examples are `detection_boxes:0` and `instances.scores`.
    """
    return name.lower().partition(":")[0].rpartition(".")[2]
