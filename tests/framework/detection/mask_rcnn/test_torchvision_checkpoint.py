"""Tests for torchvision checkpoints. If torchvision is installed, the outputs are compared."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from framework.detection.mask_rcnn.checkpoint import COCO_ROWS, from_torchvision
from framework.detection.mask_rcnn.resnet import ResNetShape
from framework.errors import DataError
from framework.vocabulary.label_spaces import COCO
from tests.support.networks.tiny_mask_rcnn import TINY, tiny_network

# fmt: off
COCO_NUMBERS = (  # ids of the 80 classes in the annotation files of COCO
    *range(1, 12), *range(13, 26), 27, 28, *range(31, 45), *range(46, 66), 67, 70, *range(72, 83), *range(84, 91),
)
# fmt: on
NINETY = tuple(f"category {number}" for number in range(1, 91))


def old_name(name):
    """Return the name of a weight at the time when the checkpoint was published."""
    name = name.replace("rpn.head.conv.0.0.", "rpn.head.conv.")
    for k in range(4):
        name = name.replace(f"fpn.inner_blocks.{k}.0.", f"fpn.inner_blocks.{k}.")
        name = name.replace(f"fpn.layer_blocks.{k}.0.", f"fpn.layer_blocks.{k}.")
        name = name.replace(f"roi_heads.mask_head.{k}.0.", f"roi_heads.mask_head.mask_fcn{k + 1}.")
    return name


def published(name="resnet50", width=2):
    """Return a network with all 91 labels and its state_dict with the old names."""
    network = tiny_network(replace(TINY, classes=NINETY, backbone=ResNetShape(name, width, norm_eps=0.0)))
    state = {old_name(k): v.clone() for k, v in network.state_dict().items() if "num_batches_tracked" not in k}
    return network, state


def test_torchvision_old_names_match_published_checkpoint():
    _, state = published()
    assert {
        "backbone.body.layer4.2.bn3.running_var",
        "backbone.body.layer1.0.downsample.1.weight",
        "backbone.fpn.inner_blocks.0.weight",
        "backbone.fpn.layer_blocks.3.bias",
        "rpn.head.conv.weight",
        "rpn.head.cls_logits.weight",
        "roi_heads.mask_head.mask_fcn1.weight",
        "roi_heads.mask_head.mask_fcn4.bias",
        "roi_heads.mask_predictor.conv5_mask.weight",
        "roi_heads.box_predictor.bbox_pred.weight",
    } <= state.keys()
    assert (
        len(state) == 53 * 5 + 16 + 6 + 8 + 12
    )  # convolutions with frozen normalization, pyramid, proposals, box, mask


@pytest.mark.parametrize("name", ["resnet50", "resnet101", "resnet18"])
def test_torchvision_coco_labels_select_80_classes(name):
    whole, state = published(name)
    network = from_torchvision(state, "here")
    assert network.architecture.classes == COCO
    assert network.architecture.backbone == ResNetShape(name, 2, norm_eps=0.0)
    assert network.architecture.truncated_strides
    rows = [0, *COCO_NUMBERS]
    assert len(rows) == 81
    assert rows == COCO_ROWS
    boxes = torch.tensor([[3.0, 5.0, 60.0, 50.0], [20.0, 10.0, 30.0, 90.0]])
    with torch.inference_mode():
        pyramid = network.extract(network.normalize(torch.rand(1, 3, 96, 128) * 255))
        logits, deltas = network.classify(pyramid, boxes)
        all_logits, all_deltas = whole.classify(pyramid, boxes)
        torch.testing.assert_close(logits, all_logits[:, rows])
        torch.testing.assert_close(deltas, all_deltas[:, rows])
        torch.testing.assert_close(network.segment(pyramid, boxes), whole.segment(pyramid, boxes)[:, rows])


def test_torchvision_new_names_and_custom_classes_are_read():
    network = tiny_network()
    again = from_torchvision(network.state_dict(), "here", TINY.classes, norm_eps=1e-5)
    assert again.architecture.backbone == TINY.backbone
    for name, tensor in again.state_dict().items():
        assert torch.equal(tensor, network.state_dict()[name]), name


def test_torchvision_invalid_checkpoints_raise():
    state = tiny_network().state_dict()
    with pytest.raises(DataError, match=r"^here: expected COCO's 91 labels, got 4; set the classes with --classes$"):
        from_torchvision(state, "here")
    with pytest.raises(DataError, match=r"^here: expected 3 classes, got 2; set them with --classes$"):
        from_torchvision(state, "here", ("chair", "couch"))
    with pytest.raises(DataError, match=r"^here: expected the weights roi_heads.box_predictor.cls_score.bias"):
        from_torchvision({k: v for k, v in state.items() if "roi_heads" not in k}, "here", TINY.classes)
    blocks = {k: v for k, v in state.items() if "layer3.1" not in k}
    with pytest.raises(DataError, match=r"expected the numbers of blocks .*, got \(2, 2, 1, 2\) blocks without"):
        from_torchvision(blocks, "here", TINY.classes)


def test_torchvision_p6_anchor_stride_is_matched():
    """At 800 px, P6 has 13 rows. Its stride is 800 // 13 = 61 px instead of 64 px."""
    _, state = published()
    network = from_torchvision(state, "here")
    pyramid = [
        torch.zeros(1, 8, rows, columns) for rows, columns in ((200, 272), (100, 136), (50, 68), (25, 34), (13, 17))
    ]
    levels = network.anchors(pyramid)
    for level, stride in zip(levels, ((4, 4), (8, 8), (16, 16), (32, 32), (61, 64)), strict=True):
        centers = (level[:, :2] + level[:, 2:]) / 2
        np.testing.assert_array_equal(np.unique(np.diff(np.unique(centers[:, 1]))), [stride[0]])
        np.testing.assert_array_equal(np.unique(np.diff(np.unique(centers[:, 0]))), [stride[1]])
    assert network.anchors(pyramid)[0][:3].tolist() == [[-23, -11, 23, 11], [-16, -16, 16, 16], [-11, -23, 11, 23]]


def test_network_outputs_match_torchvision():
    """Each step is compared, with the same random weights."""
    try:
        import torchvision
    except (ImportError, RuntimeError) as absent:  # torchvision's extension does not load with a CPU build of torch
        pytest.skip(f"torchvision: expected a usable package, got an error ({str(absent).splitlines()[0]})")
    torch.manual_seed(5)
    theirs = torchvision.models.detection.maskrcnn_resnet50_fpn(
        weights=None, weights_backbone=None, min_size=160, max_size=224
    ).eval()
    ours = from_torchvision(theirs.state_dict(), "torchvision", norm_eps=1e-5)
    rows, shape = [0, *COCO_NUMBERS], (160, 208)
    image = torch.rand(3, *shape)
    boxes = torch.tensor([[3.0, 5.0, 190.0, 150.0], [20.0, 10.0, 40.0, 90.0], [100.0, 7.0, 160.0, 61.0]])
    with torch.inference_mode():
        images, _ = theirs.transform([image])
        features = theirs.backbone(images.tensors)
        pyramid = ours.extract(ours.normalize(image[None] * 255))
        for level, expected in zip(pyramid, features.values(), strict=True):
            torch.testing.assert_close(level, expected, rtol=1e-3, atol=1e-4)
        objectness, deltas = theirs.rpn.head(list(features.values()))
        found = ours.score_anchors(pyramid)
        expected = torch.cat([level.permute(0, 2, 3, 1).flatten(1) for level in objectness], dim=1)
        torch.testing.assert_close(found[0], expected, rtol=1e-3, atol=1e-4)
        expected = torch.cat([level.permute(0, 2, 3, 1).reshape(1, -1, 4) for level in deltas], dim=1)
        torch.testing.assert_close(found[1], expected, rtol=1e-3, atol=1e-4)
        [anchors] = theirs.rpn.anchor_generator(images, list(features.values()))
        np.testing.assert_array_equal(np.concatenate(ours.anchors(pyramid)), anchors.numpy())
        heads = theirs.roi_heads
        logits, deltas = heads.box_predictor(heads.box_head(heads.box_roi_pool(features, [boxes], [shape])))
        found = ours.classify(pyramid, boxes)
        torch.testing.assert_close(found[0], logits[:, rows], rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(found[1], deltas.view(3, 91, 4)[:, rows], rtol=1e-3, atol=1e-4)
        masks = heads.mask_predictor(heads.mask_head(heads.mask_roi_pool(features, [boxes], [shape])))
        torch.testing.assert_close(ours.segment(pyramid, boxes), masks[:, rows], rtol=1e-3, atol=1e-4)
