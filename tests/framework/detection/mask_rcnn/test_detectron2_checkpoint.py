"""Tests for detectron2 checkpoints.

The outputs of the network are compared with a reference in double precision. The reference follows the definitions and
names of detectron2 and uses no code of this project. Reading a checkpoint must not execute code in the pickle.
"""

import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from framework.detection.mask_rcnn.checkpoint import CheckpointKind, read_network
from framework.detection.mask_rcnn.detectron2_checkpoint import from_detectron2, read_pickle
from framework.detection.masks.boxes import decode
from framework.errors import DataError
from framework.vocabulary.label_spaces import COCO
from tests.support.networks.roi_align_loops import roi_align_loops

STEM, CHANNELS, FEATURES = 4, 6, 10
BLOCKS = {"resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
MEAN_BGR = (103.530, 116.280, 123.675)


def synthetic_state(network="resnet50", classes=80):
    """Return a checkpoint of random float32 arrays with the names of detectron2."""
    rng = np.random.default_rng(11)
    state = {"pixel_mean": np.array(MEAN_BGR).reshape(3, 1, 1), "pixel_std": np.ones((3, 1, 1))}

    def layer(name, *shape, bias=True):
        state[f"{name}.weight"] = rng.normal(0, 1.2 / math.sqrt(np.prod(shape[1:])), shape)
        if bias:
            state[f"{name}.bias"] = rng.normal(0, 0.1, shape[0])

    def normalized(name, *shape):
        layer(name, *shape, bias=False)
        state[f"{name}.norm.weight"] = rng.uniform(0.5, 1.5, shape[0])
        state[f"{name}.norm.bias"] = rng.normal(0, 0.1, shape[0])
        state[f"{name}.norm.running_mean"] = rng.normal(0, 0.1, shape[0])
        state[f"{name}.norm.running_var"] = rng.uniform(0.5, 1.5, shape[0])

    normalized("backbone.bottom_up.stem.conv1", STEM, 3, 7, 7)
    state["backbone.bottom_up.stem.conv1.weight"] /= 60  # image values are 0 to 255
    before = STEM
    for stage, blocks in enumerate(BLOCKS[network], start=2):
        inside, out = STEM * 2 ** (stage - 2), 4 * STEM * 2 ** (stage - 2)
        for block in range(blocks):
            name = f"backbone.bottom_up.res{stage}.{block}"
            if block == 0:
                normalized(f"{name}.shortcut", out, before, 1, 1)
            normalized(f"{name}.conv1", inside, before, 1, 1)
            normalized(f"{name}.conv2", inside, inside, 3, 3)
            normalized(f"{name}.conv3", out, inside, 1, 1)
            state[f"{name}.conv3.norm.weight"] *= 0.3
            before = out
        layer(f"backbone.fpn_lateral{stage}", CHANNELS, out, 1, 1)
        layer(f"backbone.fpn_output{stage}", CHANNELS, CHANNELS, 3, 3)
    layer("proposal_generator.rpn_head.conv", CHANNELS, CHANNELS, 3, 3)
    layer("proposal_generator.rpn_head.objectness_logits", 3, CHANNELS, 1, 1)
    layer("proposal_generator.rpn_head.anchor_deltas", 12, CHANNELS, 1, 1)
    layer("roi_heads.box_head.fc1", FEATURES, CHANNELS * 49)
    layer("roi_heads.box_head.fc2", FEATURES, FEATURES)
    layer("roi_heads.box_predictor.cls_score", classes + 1, FEATURES)
    layer("roi_heads.box_predictor.bbox_pred", classes * 4, FEATURES)
    for k in range(1, 5):
        layer(f"roi_heads.mask_head.mask_fcn{k}", CHANNELS, CHANNELS, 3, 3)
    layer("roi_heads.mask_head.deconv", CHANNELS, CHANNELS, 2, 2)
    layer("roi_heads.mask_head.predictor", classes, CHANNELS, 1, 1)
    return {name: np.asarray(value, np.float32) for name, value in state.items()}


class Detectron2:
    """Reference for the inference of detectron2 (modeling/backbone, proposal_generator, roi_heads)."""

    def __init__(self, state):
        self.state = {name: torch.from_numpy(value).double() for name, value in state.items()}

    def layer(self, name, x, function=functional.conv2d, **arguments):
        return function(x, self.state[f"{name}.weight"], self.state.get(f"{name}.bias"), **arguments)

    def normalized(self, name, x, **arguments):
        x = self.layer(name, x, **arguments)
        norm = {
            k: self.state[f"{name}.norm.{k}"][:, None, None] for k in ("weight", "bias", "running_mean", "running_var")
        }
        return (x - norm["running_mean"]) / (norm["running_var"] + 1e-5).sqrt() * norm["weight"] + norm["bias"]

    def pyramid(self, rgb):
        bgr = torch.from_numpy(rgb[..., ::-1].copy()).double().permute(2, 0, 1)[None]
        x = bgr - torch.tensor(MEAN_BGR).double()[:, None, None]
        x = functional.pad(x, (0, -x.shape[3] % 32, 0, -x.shape[2] % 32))
        x = self.normalized("backbone.bottom_up.stem.conv1", x, stride=2, padding=3).relu()
        x = functional.max_pool2d(x, 3, 2, 1)
        stages = {}
        for stage in (2, 3, 4, 5):
            for block in range(100):
                name = f"backbone.bottom_up.res{stage}.{block}"
                if f"{name}.conv1.weight" not in self.state:
                    break
                stride = 2 if stage > 2 and block == 0 else 1
                shortcut = self.normalized(f"{name}.shortcut", x, stride=stride) if block == 0 else x
                y = self.normalized(f"{name}.conv1", x, stride=stride).relu()  # as with STRIDE_IN_1X1
                y = self.normalized(f"{name}.conv2", y, padding=1).relu()
                x = (self.normalized(f"{name}.conv3", y) + shortcut).relu()
            stages[stage] = x
        levels, top = [], None
        for stage in (5, 4, 3, 2):
            lateral = self.layer(f"backbone.fpn_lateral{stage}", stages[stage])
            top = lateral if top is None else lateral + functional.interpolate(top, scale_factor=2.0, mode="nearest")
            levels.insert(0, self.layer(f"backbone.fpn_output{stage}", top, padding=1))
        return [*levels, functional.max_pool2d(levels[-1], 1, 2)]

    def anchors(self, pyramid):
        """Return the anchors (A, 4), px.

        They are centered at the cell corners (OFFSET 0), and their sizes are not rounded.
        """
        anchors = []
        for level, stride, side in zip(pyramid, (4, 8, 16, 32, 64), (32, 64, 128, 256, 512), strict=True):
            for y in range(level.shape[2]):
                for x in range(level.shape[3]):
                    for ratio in (0.5, 1.0, 2.0):
                        w = math.sqrt(side**2 / ratio)
                        h = ratio * w
                        anchors.append((x * stride - w / 2, y * stride - h / 2, x * stride + w / 2, y * stride + h / 2))
        return np.array(anchors)

    def proposals(self, pyramid):
        """Return the scores (A,) and boxes (A, 4), px, of all anchors before the selection."""
        scores, deltas = [], []
        for level in pyramid:
            x = self.layer("proposal_generator.rpn_head.conv", level, padding=1).relu()
            scores.append(self.layer("proposal_generator.rpn_head.objectness_logits", x).permute(0, 2, 3, 1).flatten())
            x = self.layer("proposal_generator.rpn_head.anchor_deltas", x)
            deltas.append(x.view(1, 3, 4, *x.shape[2:]).permute(0, 3, 4, 1, 2).reshape(-1, 4))
        return torch.cat(scores).numpy(), moved(self.anchors(pyramid), torch.cat(deltas).numpy(), (1, 1, 1, 1))

    def pooled(self, pyramid, boxes, bins):
        rows = []
        for box in boxes:
            side = math.sqrt((box[2] - box[0]) * (box[3] - box[1]))
            level = min(max(math.floor(4 + math.log2(side / 224 + 1e-16)), 2), 5)
            rows.append(roi_align_loops(pyramid[level - 2][0].numpy(), [box], bins, 1 / 2**level, 0, True))
        return torch.from_numpy(np.concatenate(rows))

    def boxes(self, pyramid, boxes):
        """Return the class probabilities (N, K + 1), with the background last, and the boxes (N, K, 4), px."""
        x = self.pooled(pyramid, boxes, 7).flatten(1)
        x = self.layer("roi_heads.box_head.fc1", x, functional.linear).relu()
        x = self.layer("roi_heads.box_head.fc2", x, functional.linear).relu()
        probabilities = self.layer("roi_heads.box_predictor.cls_score", x, functional.linear).softmax(dim=1)
        deltas = self.layer("roi_heads.box_predictor.bbox_pred", x, functional.linear)
        deltas = deltas.view(len(boxes), -1, 4).numpy()
        return probabilities.numpy(), np.stack(
            [moved(boxes, deltas[:, k], (10, 10, 5, 5)) for k in range(deltas.shape[1])], axis=1
        )

    def masks(self, pyramid, boxes):
        """Return mask probabilities (N, K, 28, 28)."""
        x = self.pooled(pyramid, boxes, 14)
        for k in range(1, 5):
            x = self.layer(f"roi_heads.mask_head.mask_fcn{k}", x, padding=1).relu()
        x = self.layer("roi_heads.mask_head.deconv", x, functional.conv_transpose2d, stride=2).relu()
        return self.layer("roi_heads.mask_head.predictor", x).sigmoid().numpy()


def moved(boxes, deltas, weights):
    """Return the boxes (N, 4), px, moved by `deltas` (N, 4) like in Box2BoxTransform.apply_deltas."""
    widths, heights = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
    x, y = boxes[:, 0] + 0.5 * widths, boxes[:, 1] + 0.5 * heights
    dx, dy, dw, dh = (deltas[:, k] / weights[k] for k in range(4))
    x, y = dx * widths + x, dy * heights + y
    w, h = (np.exp(np.minimum(d, math.log(1000 / 16))) * side for d, side in ((dw, widths), (dh, heights)))
    return np.stack([x - 0.5 * w, y - 0.5 * h, x + 0.5 * w, y + 0.5 * h], axis=1)


def as_tensors(state):
    return {name: torch.from_numpy(value) for name, value in state.items()}


@pytest.mark.parametrize("name", ["resnet50", "resnet101"])
def test_detectron2_network_matches_reference(name):
    state = synthetic_state(name)
    reference, network = Detectron2(state), from_detectron2(as_tensors(state), "here")
    assert network.architecture.classes == COCO
    assert network.architecture.backbone.name == name
    rgb = np.random.default_rng(12).integers(0, 256, (150, 210, 3)).astype(np.uint8)
    boxes = np.array([[5, 7, 140, 120], [30, 20, 70, 90], [100.5, 3.25, 111, 12.5], [0, 0, 210, 150]])
    with torch.inference_mode():
        expected = reference.pyramid(rgb)
        pyramid = network.extract(network.normalize(torch.from_numpy(rgb).permute(2, 0, 1)[None]))
        for level, level_expected in zip(pyramid, expected, strict=True):
            torch.testing.assert_close(level.double(), level_expected, rtol=1e-3, atol=1e-4)
            assert level.std() > 0.05

        scores, proposals = reference.proposals(expected)
        objectness, deltas = (tensor[0].numpy() for tensor in network.score_anchors(pyramid))
        np.testing.assert_allclose(objectness, scores, rtol=1e-3, atol=1e-4)
        found = decode(np.concatenate(network.anchors(pyramid)), deltas, extent=0.0)
        np.testing.assert_allclose(found, proposals, rtol=1e-3, atol=0.05)

        probabilities, moved_boxes = reference.boxes(expected, boxes)
        given = torch.from_numpy(boxes).float()
        logits, deltas = network.classify(pyramid, given)
        found = torch.softmax(logits, dim=1).numpy()
        np.testing.assert_allclose(found[:, 0], probabilities[:, -1], rtol=1e-3)
        np.testing.assert_allclose(found[:, 1:], probabilities[:, :-1], rtol=1e-3)
        for k in (0, 41, 79):
            own = deltas[:, 1 + k].numpy() / np.array([10, 10, 5, 5], np.float32)
            np.testing.assert_allclose(decode(given.numpy(), own, extent=0.0), moved_boxes[:, k], rtol=1e-3, atol=0.02)
        masks = torch.sigmoid(network.segment(pyramid, given)).numpy()
        np.testing.assert_allclose(masks[:, 1:], reference.masks(expected, boxes), atol=1e-4)


def test_detectron2_stored_anchors_are_read():
    state = as_tensors(synthetic_state())
    cells = "proposal_generator.anchor_generator.cell_anchors"
    state[f"{cells}.1"] = torch.tensor([[-34, -17, 34, 17], [-24, -24, 24, 24], [-17, -34, 17, 34.0]])
    sides = from_detectron2(state, "here").architecture.anchor_sides
    assert sides == pytest.approx((32, 48, 128, 256, 512), abs=0.1)
    state[f"{cells}.1"] = torch.tensor([[-24.0, -24, 24, 24]])
    with pytest.raises(DataError, match=r"expected anchors with the ratios 0\.5, 1 and 2 in level 1, got \[1\.0\]"):
        from_detectron2(state, "here")


def test_detectron2_unsupported_networks_raise():
    state = as_tensors(synthetic_state())
    with pytest.raises(
        DataError,
        match=r"^here: pixel_std: expected .*, as in networks .*, got \[57\.375, 57\.12, 58\.395\]",
    ):
        from_detectron2(state | {"pixel_std": torch.tensor([57.375, 57.12, 58.395])}, "here")
    with pytest.raises(
        DataError,
        match=r"^here: expected a Mask R-CNN .*, got the weights roi_heads\.box_head\.conv1\.norm\.weight",
    ):
        from_detectron2(state | {"roi_heads.box_head.conv1.norm.weight": torch.zeros(1)}, "here")
    with pytest.raises(DataError, match=r"^here: expected the weights backbone.body.layer4.2.conv3.weight.*, got none"):
        from_detectron2({k: v for k, v in state.items() if k != "backbone.bottom_up.res5.2.conv3.weight"}, "here")
    nine = as_tensors(synthetic_state(classes=9))
    with pytest.raises(DataError, match=r"^here: expected COCO's .* classes, got 9"):
        from_detectron2(nine, "here")
    assert from_detectron2(nine, "here", COCO[:9]).architecture.classes == COCO[:9]


# Pickle files


class Runs:
    """Object that executes code when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_pickle_of_arrays_is_read(tmp_path, protocol):
    path, state = tmp_path / "model_final_abc123.pkl", synthetic_state()
    path.write_bytes(pickle.dumps({"model": state, "__author__": "Detectron2 Model Zoo"}, protocol=protocol))
    read = read_pickle(path)
    assert read.keys() == state.keys()
    for name, array in state.items():
        np.testing.assert_array_equal(read[name], array)
    assert read_network(path).architecture.backbone.name == "resnet50"


def test_pickle_with_old_numpy_module_names_is_read(tmp_path):
    path = tmp_path / "model.pkl"
    content = pickle.dumps({"model": {"a": np.arange(3.0)}}, protocol=2)
    assert b"numpy._core" in content
    path.write_bytes(content.replace(b"numpy._core", b"numpy.core"))
    np.testing.assert_array_equal(read_pickle(path)["a"], [0, 1, 2])


def test_pickle_with_code_raises_without_execution(tmp_path):
    path, touched = tmp_path / "model.pkl", tmp_path / "touched"
    path.write_bytes(pickle.dumps({"model": {"a": np.zeros(1), "b": Runs(touched)}}))
    with pytest.raises(DataError, match=r"expected a pickle of numpy arrays, got an error \(a call of") as caught:
        read_pickle(path)
    assert "\n" not in str(caught.value)
    assert not touched.exists()
    pickle.loads(path.read_bytes())  # the standard unpickler executes the code
    assert touched.exists()


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", "expected a pickle of numpy arrays"),
        (b"not a pickle", "expected a pickle of numpy arrays"),
        (pickle.dumps({"model": {"a": np.zeros(9)}})[:-20], "expected a pickle of numpy arrays"),
        (pickle.dumps(["a"]), "expected a dictionary of detectron2's numpy arrays, got list"),
        (
            pickle.dumps({"model": {"a": "text"}}),
            "expected a dictionary of detectron2's numpy arrays, got dict",
        ),
        (pickle.dumps({"model": {"a": np.array(["text"])}}), "expected arrays of numbers, got a of type <U4"),
    ],
)
def test_pickle_damaged_raises(tmp_path, content, fault):
    path = tmp_path / "model.pkl"
    path.write_bytes(content)
    with pytest.raises(DataError, match=fault) as caught:
        read_network(path)
    assert "\n" not in str(caught.value)


def test_pth_of_detectron2_trainer_is_read(tmp_path):
    path, state = tmp_path / "model_final.pth", as_tensors(synthetic_state())
    torch.save({"model": state, "iteration": 3}, path)
    assert read_network(path).architecture.half_pixel
    assert read_network(path, CheckpointKind.DETECTRON2).architecture.half_pixel
    with pytest.raises(DataError, match=r"roi_heads.box_predictor.cls_score.bias|91"):
        read_network(path, CheckpointKind.TORCHVISION)


def test_pth_with_invalid_content_raises(tmp_path):
    path, touched = tmp_path / "model.pth", tmp_path / "touched"
    torch.save({"model": {"a": Runs(touched)}}, path)
    for content in (None, b"<html>", b""):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(
            DataError, match=r"model\.pth: expected a file with weights only, got a damaged or unsupported file:"
        ) as caught:
            read_network(path)
        assert "\n" not in str(caught.value)
    assert not touched.exists()
    torch.save({"model": {"a": torch.zeros(1)}}, path)
    with pytest.raises(
        DataError, match="expected a Mask R-CNN of torchvision or detectron2 with a feature pyramid, got the weights a"
    ):
        read_network(path)
    torch.save([1], path)
    with pytest.raises(DataError, match=r"expected a state_dict of tensors, alone or under the key `model`, got list"):
        read_network(path)
