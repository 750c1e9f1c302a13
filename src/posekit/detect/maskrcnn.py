"""Mask R-CNN (He et al., 2017), from torchvision: its shape, its weights on disk, and detection with it."""

from __future__ import annotations

import dataclasses
import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from posekit.camera import box_iou
from posekit.detect.backbones import BACKBONES, feature_pyramid
from posekit.detect.sharpen import sharpened
from posekit.detect.vision import torchvision
from posekit.errors import ConfigError, WeightsError
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.mesh.model import ObjectModel
from posekit.nets.lite0 import LITE0_MEAN, LITE0_STD
from posekit.results import Detection, Source
from posekit.view import View

KIND = "mask-rcnn"
NOVEL = ("object",)  # the one class of a class-agnostic detector
SHIPPED = Path(__file__).resolve().parent.parent / "weights" / "detector-novel"
Augmentation = tuple[
    float, bool
]  # at the picture: its size over the configuration's ``use_size``, and whether it is mirrored
AUGMENTATIONS: dict[str, tuple[Augmentation, ...]] = {
    "lite0": ((1.0, False), (4 / 3, False), (1.0, True), (4 / 3, True)),
    "resnet50": ((1.0, False),),
}
DOUBTFUL = 0.05  # score of an augmentation's detections that may be joined with another augmentation's
SAME = 0.5  # intersection over union from which two augmentations' boxes are of one instance
COCO = "coco"


@dataclass(frozen=True)
class MaskRCNNConfig:
    """The network of a detector and how it is used."""

    backbone: str = "lite0"  # "lite0" or "resnet50"
    classes: tuple[str, ...] = NOVEL  # names, without the background
    size: tuple[int, int] = (320, 240)  # (width, height) that pictures are fitted into in training
    use_size: tuple[int, int] = (480, 360)  # the same in use; small objects want it larger
    channels: int = 64  # of the pyramid
    hidden: int = 256  # width of the box head
    anchors: tuple[int, ...] = (16, 32, 64, 128)  # sides, one for each level of the pyramid, pixels
    proposals: tuple[int, int] = (120, 120)  # regions kept in training and in use
    samples: int = 48  # regions that the heads learn from in a picture

    def __post_init__(self) -> None:
        if self.backbone not in BACKBONES:
            raise ConfigError(f"the backbone is one of {', '.join(BACKBONES)}, not {self.backbone!r}.")
        if not self.classes:
            raise ConfigError("a detector needs at least one class.")

    @property
    def novel(self) -> bool:
        """Whether it finds objects of any kind."""
        return self.classes == NOVEL


def paper_config(classes: Sequence[str]) -> MaskRCNNConfig:
    """ResNet-50 with FPN as in the paper, at 640x480."""
    return MaskRCNNConfig(
        "resnet50", tuple(classes), (640, 480), (640, 480), 256, 1024, (32, 64, 128, 256, 512), (1000, 300), 256
    )


def build(config: MaskRCNNConfig, *, imagenet: bool = False) -> Any:
    """The network (a torchvision MaskRCNN), its backbone from ImageNet weights or untrained."""
    vision = torchvision()
    detection = vision.models.detection
    body = feature_pyramid(config.backbone, config.channels, imagenet=imagenet)
    levels = [str(k) for k in range(4)]
    count = len(config.classes) + 1
    shapes = detection.anchor_utils.AnchorGenerator(
        tuple((side,) for side in config.anchors), ((0.5, 1.0, 2.0),) * len(config.anchors)
    )
    align = vision.ops.MultiScaleRoIAlign
    box_pool = align(levels, 7, 2, canonical_scale=_canonical(config))
    mask_pool = align(levels, 14, 2, canonical_scale=_canonical(config))
    wide = body.out_channels
    layers = (wide,) * (2 if config.backbone == "lite0" else 4)
    width, height = config.size
    # TF's and torchvision's ImageNet weights were trained with their own means
    lite = config.backbone == "lite0"
    return detection.MaskRCNN(
        body, min_size=min(width, height), max_size=max(width, height),
        image_mean=[LITE0_MEAN] * 3 if lite else None, image_std=[LITE0_STD] * 3 if lite else None,
        rpn_anchor_generator=shapes, rpn_pre_nms_top_n_train=3 * config.proposals[0], rpn_pre_nms_top_n_test=
        3 * config.proposals[1], rpn_post_nms_top_n_train=config.proposals[0], rpn_post_nms_top_n_test=
        config.proposals[1], rpn_batch_size_per_image=128,
        box_roi_pool=box_pool,
        box_head=detection.faster_rcnn.TwoMLPHead(wide * 49, config.hidden),
        box_predictor=detection.faster_rcnn.FastRCNNPredictor(config.hidden, count),
        box_batch_size_per_image=config.samples, box_detections_per_img=50, box_nms_thresh=0.5,
        mask_roi_pool=mask_pool,
        mask_head=detection.mask_rcnn.MaskRCNNHeads(wide, layers, 1),
        mask_predictor=detection.mask_rcnn.MaskRCNNPredictor(wide, wide, count),
    )  # fmt: skip


def _canonical(config: MaskRCNNConfig) -> int:
    """The size of a region that is pooled from stride 16: ImageNet's 224 pixels, less in smaller pictures."""
    return 224 if config.backbone == "resnet50" else 112


@dataclass(frozen=True, eq=False)
class TrainedDetector:
    """A network with what it was made for. digest: of its weights; about: its training."""

    config: MaskRCNNConfig
    network: Any
    digest: str = "untrained"
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def save_detector(path: Path, config: MaskRCNNConfig, network: nn.Module, about: Mapping[str, Any]) -> str:
    """Write ``path``.safetensors in fp16 and ``path``.toml; returns the weights' hash."""
    state = {k: v.detach().half().contiguous() if v.is_floating_point() else v.detach().contiguous()
             for k, v in network.state_dict().items()}  # fmt: skip
    data = save(state)
    digest = hashlib.sha256(data).hexdigest()[:16]
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(config).items()}
    head = {"kind": KIND, "sha256_16": digest, "config": values, "about": dict(about)}
    write_bytes_atomic(path.with_suffix(".safetensors"), data)
    write_text_atomic(path.with_suffix(".toml"), tomli_w.dumps(head))
    return digest


def load_detector(path: Path) -> TrainedDetector:
    """Read weights strictly. path: the file, its stem, or a folder with ``detector.safetensors``. Raises WeightsError
    where a file is missing, damaged or of something else."""
    candidates = [path / "detector.safetensors", path.with_suffix(".safetensors")]
    file = next((c for c in candidates if c.is_file()), None)
    if file is None:
        raise WeightsError(
            f"no detector at {path}: expected a .safetensors file with its .toml beside it, or a folder of posekit "
            "train detector."
        )
    about = file.with_suffix(".toml")
    try:
        head = tomllib.loads(about.read_text(encoding="utf-8"))
        data = file.read_bytes()
        state = load(data)
    except FileNotFoundError as error:
        raise WeightsError(f"{file.name} needs {about.name} beside it: {error}") from error
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, SafetensorError) as error:
        raise WeightsError(f"the detector {file} is damaged: {error}. Fetch or train it anew.") from error
    if head.get("kind") != KIND:
        raise WeightsError(
            f"{file} holds no Mask R-CNN but something else (pose networks?): pass a detector's weights."
        )
    digest = hashlib.sha256(data).hexdigest()[:16]
    if digest != head.get("sha256_16"):
        raise WeightsError(f"{file} and {about.name} do not belong together (hash {digest}). Fetch them anew.")
    config = _config(head.get("config", {}), about)
    network = build(config)
    _load_strictly(network, state, file)
    return TrainedDetector(config, network.eval(), digest, head.get("about", {}))


def load_coco() -> TrainedDetector:
    """The COCO weights of torchvision, by its own loader, which downloads them once. Raises WeightsError."""
    models = torchvision().models.detection
    weights = models.MaskRCNN_ResNet50_FPN_Weights.COCO_V1
    try:
        network = models.maskrcnn_resnet50_fpn(weights=weights)
    except OSError as error:
        raise WeightsError(
            f"torchvision could not fetch its COCO weights ({error}): this needs the internet once. Without it use "
            "the detector 'novel' (--detector novel), or weights of posekit train detector."
        ) from error
    classes = tuple(weights.meta["categories"][1:])
    config = dataclasses.replace(paper_config(classes), use_size=(1333, 800))
    return TrainedDetector(config, network.eval(), str(weights), {"trained_on": "COCO"})


def _config(values: Mapping[str, Any], file: Path) -> MaskRCNNConfig:
    known = {f.name for f in dataclasses.fields(MaskRCNNConfig)}
    unknown = set(values) - known
    if unknown:
        raise WeightsError(f"{file} has unknown keys {sorted(unknown)} in its configuration; known: {sorted(known)}.")
    chosen: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return MaskRCNNConfig(**chosen)


def _load_strictly(network: nn.Module, state: Mapping[str, Tensor], file: Path) -> None:
    state = {k: v.float() if v.is_floating_point() else v for k, v in state.items()}
    if not all(torch.isfinite(v).all() for v in state.values() if v.is_floating_point()):
        raise WeightsError(f"the detector {file} holds numbers that are not finite.")
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        raise WeightsError(f"the detector {file} does not fit its configuration: {error}") from error


@dataclass(frozen=True, eq=False)
class Found:
    """What the network finds in a picture: boxes (N, 4), edges; labels (N,), numbers of classes from 0; scores (N,);
    masks bool (N, H, W). By falling score."""

    boxes: NDArray[np.float64]
    labels: NDArray[np.int64]
    scores: NDArray[np.float64]
    masks: NDArray[np.bool_]


def find(
    detector: TrainedDetector,
    image: NDArray[np.uint8],
    *,
    min_score: float = 0.05,
    max_detections: int = 50,
    size: tuple[int, int] | None = None,
) -> Found:
    """Run the network on uint8 RGB (H, W, 3). min_score: score below which nothing is reported. size: (width, height)
    that the picture is fitted into, by default the configuration's ``use_size``."""
    network = detector.network
    size = size or detector.config.use_size
    network.transform.min_size, network.transform.max_size = (min(size),), max(size)
    network.roi_heads.score_thresh, network.roi_heads.detections_per_img = min_score, max_detections
    pixels = torch.from_numpy(image).permute(2, 0, 1).float() / 255
    with torch.inference_mode():
        out = network([pixels])[0]
    masks = (out["masks"][:, 0] > 0.5).numpy()
    kept = masks.any((1, 2))
    return Found(
        out["boxes"].double().numpy()[kept],
        out["labels"].numpy()[kept] - 1,
        out["scores"].double().numpy()[kept],
        masks[kept],
    )


def find_augmented(
    detector: TrainedDetector,
    image: NDArray[np.uint8],
    augmentations: Sequence[Augmentation],
    *,
    min_score: float,
    max_detections: int = 50,
) -> Found:
    """Test-time augmentation: detections of several versions of a picture; what overlaps by half and has the same label
    is joined: the mean of the scores (0 from a version without it), the boxes' mean weighted by score, the mask of the
    highest score.

    min_score: of the joined score. max_detections: of each version. Raises ValueError without augmentations.
    """
    seen = [
        _found_in(detector, image, augmentation, min(min_score, DOUBTFUL), max_detections)
        for augmentation in augmentations
    ]
    which = np.repeat(np.arange(len(seen)), [len(found.scores) for found in seen])
    boxes, labels, scores, masks = (
        np.concatenate([getattr(found, name) for found in seen]) for name in ("boxes", "labels", "scores", "masks")
    )
    overlaps = box_iou(boxes[:, None], boxes[None])
    order, groups = np.argsort(-scores, kind="stable"), []
    while len(order):
        same = (overlaps[order[0], order] > SAME) & (labels[order] == labels[order[0]])
        same[0] = True  # even where it has no area
        groups.append(order[same])
        order = order[~same]
    means = np.array([_mean_score(scores[group], which[group], len(augmentations)) for group in groups])
    kept = [groups[k] for k in np.argsort(-means, kind="stable") if means[k] >= min_score]
    first = [group[0] for group in kept]
    return Found(
        np.array([np.average(boxes[g], axis=0, weights=scores[g] + 1e-6) for g in kept]).reshape(-1, 4),
        labels[first],
        -np.sort(-means[means >= min_score]),
        masks[first],
    )


def _found_in(
    detector: TrainedDetector,
    image: NDArray[np.uint8],
    augmentation: Augmentation,
    min_score: float,
    max_detections: int,
) -> Found:
    scale, mirrored = augmentation
    size = round(scale * detector.config.use_size[0]), round(scale * detector.config.use_size[1])
    if not mirrored:
        return find(detector, image, min_score=min_score, max_detections=max_detections, size=size)
    found = find(
        detector, np.ascontiguousarray(image[:, ::-1]), min_score=min_score, max_detections=max_detections, size=size
    )
    boxes = found.boxes.copy()
    boxes[:, [0, 2]] = image.shape[1] - boxes[:, [2, 0]]
    return replace(found, boxes=boxes, masks=found.masks[:, :, ::-1])


def _mean_score(scores: NDArray[np.float64], which: NDArray[np.int64], augmentations: int) -> float:
    return (
        sum(float(scores[which == augmentation].max(initial=0.0)) for augmentation in range(augmentations))
        / augmentations
    )


class MaskRCNN:
    """A Detector that was trained for its classes; a model is found by its name. min_score: of a detection.
    max_detections: of one class, 0 = all. `AUGMENTATIONS` says how a picture is augmented for its backbone."""

    def __init__(self, detector: TrainedDetector, min_score: float = 0.5, max_detections: int = 0) -> None:
        self.detector, self.min_score, self.max_detections = detector, min_score, max_detections

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """Instances of the models, by falling score; with no models, of all classes. Raises ConfigError where a model
        is no class."""
        classes = self.detector.config.classes
        unknown = [m.name for m in models if m.name not in classes]
        if unknown:
            raise ConfigError(
                f"this detector does not know {', '.join(unknown)}; it was trained for {', '.join(classes)}. Use "
                "the detector 'novel' (--detector novel), or train one with posekit train detector."
            )
        found = find_augmented(
            self.detector, view.image, AUGMENTATIONS[self.detector.config.backbone], min_score=self.min_score
        )
        left = dict.fromkeys([m.name for m in models] or classes, self.max_detections or len(found.labels))
        detections = []
        for box, label, score, mask in zip(found.boxes, found.labels, found.scores, found.masks, strict=True):
            name = classes[label]
            if left.get(name, 0):
                left[name] -= 1
                detections.append(sharpened(view.image, Detection(_box(box), mask, float(score), name, Source.TRAINED)))
        return detections


def _box(values: NDArray[np.float64]) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = (float(v) for v in values)
    return x0, y0, x1, y1
