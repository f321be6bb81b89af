"""Segmentation networks of Hugging Face transformers.

The networks have a number of queries. Each query returns a mask and a class distribution.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from framework.config.validation import LONGEST_SIDE, MAX_DETECTIONS, check_count, check_intervals, require
from framework.data import Detections, Float32, Frame, UInt8
from framework.detection.hub.hub_model import PREPROCESSING, commit_of, find_model, imported_transformers, read_part
from framework.detection.hub.image_text import IMAGENET_MEAN, IMAGENET_STD
from framework.detection.masks.binary_masks import without_duplicates
from framework.detection.runtimes.device import torch_device
from framework.detection.stored.fingerprint import fingerprint
from framework.errors import DataError, errors_of
from framework.files.json_file import read_json
from framework.interfaces import Detector
from framework.vocabulary.label_spaces import COCO, COCO_BY_ID, NO_CLASS, ClassNames, to_class_names

RESAMPLING = {2: "bilinear", 3: "bicubic"}  # by Pillow's constants
PLACEHOLDER = re.compile(r"LABEL_\d+|N/A", re.IGNORECASE)  # name of an unnamed class or unused id


@dataclass(frozen=True)
class Family:
    """Conventions of a family of architectures with Q queries and C labels."""

    auto_class: str  # auto class of transformers
    logits: str  # output with the class logits, (1, Q, C or C + 1)
    masks: str  # output with the mask logits, (1, Q, h, w)
    any_size: bool  # True = the network accepts images of any size
    mask_quality: bool  # True = the score is multiplied by the mean probability inside the mask, as published


UNIVERSAL, INSTANCE = "AutoModelForUniversalSegmentation", "AutoModelForInstanceSegmentation"
_MASK_FORMER = Family(UNIVERSAL, "class_queries_logits", "masks_queries_logits", any_size=True, mask_quality=True)
_EOMT = replace(_MASK_FORMER, any_size=False)
FAMILIES = {
    "mask2former": _MASK_FORMER,
    "maskformer": _MASK_FORMER,
    "eomt": _EOMT,
    "eomt_dinov3": _EOMT,
    "detr": Family(UNIVERSAL, "logits", "pred_masks", any_size=True, mask_quality=False),
    "rf_detr": Family(INSTANCE, "logits", "pred_masks", any_size=False, mask_quality=False),
}
"""Families by the `model_type` in a model's config.json."""


@dataclass
class TransformersSegmentation(Detector):
    """Mask2Former, MaskFormer, EoMT, RF-DETR-Seg or DETR by model id or local folder; needs the extra `transformers`.

    A model that is not in the cache of huggingface_hub is downloaded, unless HF_HUB_OFFLINE=1. Use checkpoints for
    instance or panoptic segmentation, because semantic checkpoints have one mask for all objects of a class. Labels are
    mapped to COCO names (framework/vocabulary/label_spaces.yaml), and detections of other labels, such as walls, are
    dropped. `class_names` changes this.

    The class distribution of a detection is the softmax over the logits of the labels, without "no object". For
    networks with independent sigmoids, it is the distribution under the condition that exactly one label is true. The
    score is the probability of the best label, including "no object" if the network has it. For MaskFormer, Mask2Former
    and EoMT, the score is multiplied by the mean probability inside the mask, as published.
    """

    model: str = "facebook/mask2former-swin-tiny-coco-instance"  # model: id on huggingface.co or folder
    revision: str = "main"  # branch, tag or commit of the model repository
    # class names: COCO, OWN (those of the model) or AUTO (COCO for names of known label spaces, otherwise OWN)
    class_names: ClassNames = ClassNames.AUTO
    # minimum score of a detection, in [0, 1); low, because low-score detections can update existing instances
    score_threshold: float = 0.1
    agnostic_nms_iou: float = 0.6  # mask IoU threshold of non-maximum suppression across classes, in (0, 1]; 1 = off
    max_detections: int = 100  # maximum number of detections per image, >= 1
    short_side: int = 0  # short side of the resized image, px, 0 or >= 32; 0 = as in the published model
    long_side: int = 0  # maximum long side of the resized image, px, 0 or >= short_side; must be 0 if short_side is 0
    mask_threshold: float = 0.5  # minimum mask probability of a pixel in the mask, in (0, 1)
    half_precision: bool = True  # True = half precision on CUDA; the CPU always uses single precision
    device: str = "auto"  # device of the network: auto, cpu or cuda; auto = cuda if available
    reads = ("color",)

    def __post_init__(self) -> None:
        check_intervals("detector", self, score_threshold="[0, 1)", agnostic_nms_iou="(0, 1]", mask_threshold="(0, 1)")
        check_count("detector.max_detections", self.max_detections, MAX_DETECTIONS)
        short, long = self.short_side, self.long_side
        require(short == 0 or short >= 32, "detector.short_side", short, "0 (as published) or at least 32 px")
        allowed = f"a value in [{short}, {LONGEST_SIDE}] px" if short else "0 if short_side is 0"
        require(short <= long <= (LONGEST_SIDE if short else 0), "detector.long_side", long, allowed)
        self._device = torch_device(self.device)
        checkpoint = Checkpoint(self.model, self.revision)
        self._family = checkpoint.family
        path = checkpoint.folder / PREPROCESSING
        with errors_of("detector.model"):
            self._preprocessing = Preprocessing.parse(read_json(path), str(path))
        if short:
            require(self._family.any_size, "detector.short_side", short, "0 (this model has a fixed input size)")
            size = {"shortest_edge": short, "longest_edge": long}
            self._preprocessing = replace(self._preprocessing, size=size)
        self._mapping = to_class_names(checkpoint.labels, self.class_names, "detector.model")
        self.classes = self._mapping.classes
        self._network = checkpoint.read_network().to(self._device)
        self._commit = commit_of(checkpoint.folder)

    def fingerprint(self) -> str:
        return f"{fingerprint(self)} {self._commit}"

    @torch.inference_mode()
    def detect(self, frame: Frame) -> Detections:
        shape = frame.camera.shape
        pixels, covered = self._preprocessing(frame.color, self._device)
        logits, grids = self._predict(pixels)
        distributions, best = class_distributions(logits, len(self._mapping.meaning))
        class_probabilities, known = self._mapping.apply(distributions)
        candidates = np.argsort(-best, kind="stable")
        candidates = candidates[(known & (best > self.score_threshold))[candidates]][: self.max_detections]

        mask_logits = resample_masks(grids[torch.from_numpy(candidates).to(self._device)], covered, shape)
        inside = mask_logits > math.log(self.mask_threshold / (1 - self.mask_threshold))
        scores = best[candidates]
        if self._family.mask_quality:
            scores = scores * mean_probability(mask_logits, inside)
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > self.score_threshold]
        masks, scores, candidates = inside.cpu().numpy()[order], scores[order], candidates[order]
        return without_duplicates(masks, scores, class_probabilities[candidates], self.classes, self.agnostic_nms_iou)

    def _predict(self, pixels: Tensor) -> tuple[Float32, Tensor]:
        """Return the class logits (Q, C or C + 1) and the mask logits (Q, h, w) of the queries."""
        half = self.half_precision and self._device.type == "cuda"
        with torch.autocast(self._device.type, torch.float16, enabled=half):
            output = self._network(pixel_values=pixels)
        logits, grids = output[self._family.logits][0].float(), output[self._family.masks][0].float()
        if not (torch.isfinite(logits).all() and torch.isfinite(grids).all()):
            advice = "; set detector.half_precision=false" if half else ""
            raise DataError(f"detector.model: expected finite outputs of {self.model}, got NaN or infinity{advice}")
        return np.asarray(logits.cpu().numpy(), np.float32), grids


def class_distributions(logits: Float32, labels: int) -> tuple[Float32, Float32]:
    """Return the class distribution (Q, C) of each query, and the probability (Q,) of its best label.

    Args:
        logits: The class logits of the queries: (Q, C + 1) with "no object" as the last label, or (Q, C) for
            independent sigmoids.
        labels: The number of labels C.
    """
    if logits.shape[1] not in (labels, labels + 1):
        raise DataError(
            f"detector.model: expected {labels} or {labels + 1} class logits ({labels} labels in config.json), got "
            f"{logits.shape[1]}; choose another model"
        )
    # Softmax without "no object". For independent sigmoids p_c, the distribution with exactly one true label is
    # P(c) ~ p_c prod_{j != c} (1 - p_j) ~ p_c / (1 - p_c) = exp(logit_c).
    objects = logits[:, :labels]
    highest = objects.max(axis=1, keepdims=True)
    weights = np.exp(objects - highest, dtype=np.float64)
    total = weights.sum(axis=1, keepdims=True)
    if logits.shape[1] == labels:
        log_best = -np.logaddexp(0, -highest, dtype=np.float64)
    else:
        log_best = -np.logaddexp(np.log(total), logits[:, labels:] - highest)
    return (weights / total).astype(np.float32), np.exp(log_best[:, 0]).astype(np.float32)


def resample_masks(grids: Tensor, covered: tuple[float, float], shape: tuple[int, int]) -> Tensor:
    """Return the mask logits (N, H, W) at the pixels of an image.

    Args:
        grids: The mask logits (N, h, w) over the input of the network.
        covered: The fractions of the height and width of the input that the image covers, from the upper left.
        shape: The height and width of the image.
    """
    axes = [
        (torch.arange(size, device=grids.device, dtype=torch.float32) + 0.5) * (2 * fraction / size) - 1
        for size, fraction in zip(shape, covered, strict=True)
    ]
    v, u = torch.meshgrid(*axes, indexing="ij")
    positions = torch.stack([u, v], dim=-1)[None]
    return functional.grid_sample(grids[None], positions, padding_mode="border", align_corners=False)[0]


def mean_probability(mask_logits: Tensor, inside: Tensor) -> Float32:
    """Return the mean mask probability (N,) inside each mask, 0 for an empty mask.

    Args:
        mask_logits: The mask logits (N, H, W).
        inside: A Boolean array (N, H, W), True inside the mask.
    """
    total = (torch.sigmoid(mask_logits) * inside).sum(dim=(1, 2))
    return np.asarray((total / inside.sum(dim=(1, 2)).clamp(min=1)).cpu().numpy(), np.float32)


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing of images according to preprocessor_config.json.

    The image processors of transformers are not used, because they require torchvision.
    """

    size: Mapping[str, int] | None  # target size, px, with the keys in the file; None = original size
    divisor: int  # px; sides are rounded up to multiples of it
    pad_to: tuple[int, int] | None  # padded (height, width), px, black at the right and bottom; None = no padding
    mode: str  # interpolation mode: bilinear or bicubic
    factor: float  # factor for the values 0..255
    mean: tuple[float, ...]  # RGB, subtracted after the factor is applied
    std: tuple[float, ...]  # RGB, divides the difference

    @classmethod
    def parse(cls, content: Mapping[str, Any], where: str) -> Preprocessing:
        """Return the settings in the content of a file.

        Args:
            content: The content of the file.
            where: The path of the file, for error messages.

        Raises:
            DataError: If settings are missing or unsupported.
        """
        if content.get("do_split_image"):
            raise DataError(
                f"{where}: expected an instance segmentation model, got a model for semantic segmentation "
                "(do_split_image); choose another model"
            )
        if content.get("pad_size"):
            raise DataError(f"{where}: pad_size: expected no value, got {content['pad_size']}; choose another model")
        if content.get("resample", 2) not in RESAMPLING:
            raise DataError(
                f"{where}: resample: expected 2 (bilinear) or 3 (bicubic), got {content['resample']}; choose another "
                "model"
            )
        size = content.get("size") if content.get("do_resize", True) else None
        if isinstance(size, int):  # files before 2023
            size = {"shortest_edge": size, "longest_edge": content.get("max_size", size)}
        keys = {key for key, value in (size or {}).items() if value}
        known = ({"shortest_edge", "longest_edge"}, {"max_height", "max_width"}, {"height", "width"})
        if content.get("do_resize", True) and keys not in known:
            raise DataError(
                f"{where}: size: expected height and width, max_height and max_width, or shortest_edge and "
                f"longest_edge, got {size}; choose another model"
            )
        normalizes = content.get("do_normalize", True)
        pads = content.get("do_pad") and str(content.get("image_processor_type", "")).startswith("Eomt")
        return cls(
            size={key: int(size[key]) for key in keys} if size else None,
            divisor=int(content.get("size_divisor") or content.get("size_divisibility") or 1),
            # other processors pad only to the largest image of a batch
            pad_to=(size["shortest_edge"], size["longest_edge"]) if pads and size else None,
            mode=RESAMPLING[content.get("resample", 2)],
            factor=content.get("rescale_factor", 1 / 255) if content.get("do_rescale", True) else 1.0,
            mean=tuple(content.get("image_mean", IMAGENET_MEAN)) if normalizes else (0.0, 0.0, 0.0),
            std=tuple(content.get("image_std", IMAGENET_STD)) if normalizes else (1.0, 1.0, 1.0),
        )

    def resized(self, shape: tuple[int, int]) -> tuple[int, int]:
        """Return the height and width of the resized image, px, given those of the original image."""
        if self.size is None:
            return shape
        height, width = shape
        if "height" in self.size:
            height, width = self.size["height"], self.size["width"]
        elif "max_height" in self.size:
            scale = min(self.size["max_height"] / height, self.size["max_width"] / width)
            height, width = int(height * scale), int(width * scale)
        else:
            height, width = _with_short_side(shape, self.size["shortest_edge"], self.size["longest_edge"])
        return -(-height // self.divisor) * self.divisor, -(-width // self.divisor) * self.divisor

    def __call__(self, color: UInt8, device: torch.device) -> tuple[Tensor, tuple[float, float]]:
        """Return the network input (1, 3, H, W) for an image (h, w, 3).

        The second result contains the fractions of H and W that the image covers.
        """
        pixels = torch.from_numpy(color).to(device).permute(2, 0, 1)[None].float()
        height, width = self.resized((color.shape[0], color.shape[1]))
        if (height, width) != color.shape[:2]:
            # antialiased, as in Pillow
            pixels = functional.interpolate(pixels, (height, width), mode=self.mode, antialias=True).clamp_(0, 255)
        covered = 1.0, 1.0
        if self.pad_to is not None:
            pad_height, pad_width = (max(0, to - side) for to, side in zip(self.pad_to, (height, width), strict=True))
            pixels = functional.pad(pixels, (0, pad_width, 0, pad_height))
            covered = height / (height + pad_height), width / (width + pad_width)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (self.mean, self.std))
        return (pixels * self.factor - mean) / std, covered


def _with_short_side(shape: tuple[int, int], short: int, long: int) -> tuple[int, int]:
    """Return the resized height and width, px, for a given shorter side and a maximum longer side."""
    smaller, larger = min(shape), max(shape)
    exact: float = short
    if larger / smaller * short > long:
        exact = long * smaller / larger
    side = round(exact)  # rounding as in the transforms of DETR
    other = larger if smaller == side else int(exact * larger / smaller)
    return (side, other) if shape[0] <= shape[1] else (other, side)


class Checkpoint:
    """A model on huggingface.co or in a folder.

    Code in the model is never run.
    """

    def __init__(self, model: str, revision: str) -> None:
        transformers = imported_transformers()
        self.folder = find_model(model, revision)
        self.config = read_part("detector.model", self.folder, "config.json", transformers.AutoConfig)
        kind = self.config.model_type
        require(kind in FAMILIES, "detector.model", f"{model} ({kind})", f"one of {', '.join(FAMILIES)}")
        self.family = FAMILIES[kind]
        self._auto_class = getattr(transformers, self.family.auto_class)

    @property
    def labels(self) -> Sequence[str]:
        """Names of the classes, NO_CLASS for unnamed classes."""
        named = {k: name for k, name in self.config.id2label.items() if not PLACEHOLDER.fullmatch(name)}
        names = [named.get(k, NO_CLASS) for k in range(max(self.config.id2label) + 1)]
        # RF-DETR models for COCO use annotation ids; their configs have no names, or the COCO names without gaps
        known = {name.lower() for name in names} - {NO_CLASS}
        if self.config.model_type == "rf_detr" and len(names) == len(COCO_BY_ID) and known in (set(COCO), set()):
            return COCO_BY_ID
        if not named:
            raise DataError(
                f"detector.model: {self.folder}: expected class names, got none; fill id2label in its config.json"
            )
        return names

    def read_network(self) -> torch.nn.Module:
        """Return the network in float32 on the CPU.

        Raises:
            DataError: If weights are missing or do not fit.
        """
        network, loading = read_part(
            "detector.model", self.folder, "the weights", self._auto_class, output_loading_info=True
        )
        # transformers only warns, and initializes missing weights randomly
        missing = sorted(set(loading["missing_keys"]) & {name for name, _ in network.named_parameters()})
        if missing:
            raise DataError(
                f"detector.model: {self.folder}: expected a checkpoint for segmentation, got no weights for "
                f"{len(missing)} of the network's tensors ({', '.join(missing[:3])}, ...); choose another model"
            )
        module: torch.nn.Module = network.float().eval()
        return module
