"""Objects that no detector was trained for: class-agnostic proposals, compared with a mesh's templates.

A class-agnostic Mask R-CNN proposes instances of anything, in more than one size of the picture. Each is
compared with the mesh: by ImageNet's features over the silhouette, by their median chroma, and, the likeliest,
by the template search that also gives first poses (silhouette and normalised colour).
What each contributes is measured in docs/decisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from posekit.camera import Box, Camera, box_iou, mask_iou
from posekit.detect import Detector
from posekit.detect.maskrcnn import COCO, DOUBTFUL, SHIPPED, MaskRCNN, TrainedDetector, find, load_coco, load_detector
from posekit.detect.sharpen import sharpened
from posekit.detect.similarity import with_similarity
from posekit.detect.vision import torchvision
from posekit.errors import ConfigError
from posekit.first_pose.features import FeatureSearch
from posekit.first_pose.hypotheses import TemplateSearch
from posekit.geometry import Pose, fibonacci_sphere, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.lite0 import LITE0_MEAN, LITE0_STD, Lite0, lite0_imagenet, load_lite0
from posekit.render import Light, Renderer
from posekit.results import Detection, Source
from posekit.view import View
from posekit.zoom import zoom_to_box

FArray = NDArray[np.float32]

ANY = "novel"  # the name of the shipped detector
SIDE = 96  # pixels of the pictures whose features are compared
LEVELS = {"2": 16, "3": 32}  # of the features, and their strides
MARGIN = 1.1
SCREENED, LEAST_SIMILARITY = 24, 0.05  # detections of a mesh that poses choose among, and the least similarity of one


@dataclass(frozen=True)
class NovelOptions:
    """How `NovelDetector` looks for objects that no detector was trained for."""

    scales: tuple[float, ...] = (2 / 3, 1.0, 4 / 3)  # of the detector's ``use_size``, one run of the detector each
    proposals: int = 80  # of a run at most
    same: float = 0.7  # intersection over union of boxes from which two scales propose the same
    screened: int = 40  # proposals that are compared with templates
    min_proposal_score: float = 0.1  # their least score
    min_score: float = 0.3  # the least score of a detection
    max_detections: int = 3  # detections of a mesh
    features: float = 3.0  # weight of the features against the templates
    chroma: float = 60.0  # difference of the median a and b (CIELAB, 8 bits) at which a score falls to 1/e
    objectness: float = 0.2  # power of the proposal's own score
    views: int = 66  # pictures of a mesh whose features are kept
    sharpen: bool = True  # fit the masks to the colours of the photograph, see `sharpened`
    overlap: float = 0.5  # intersection over union of masks from which two detections are of one instance

    def __post_init__(self) -> None:
        if (
            min(len(self.scales), self.proposals, self.screened, self.max_detections, self.views) < 1
            or self.features < 0
        ):
            raise ConfigError(
                "scales, proposals, screened, max_detections and views are at least 1, features not negative."
            )


TO_VERIFY = NovelOptions(
    max_detections=SCREENED, min_score=LEAST_SIMILARITY, sharpen=False
)  # for poses to choose among


@dataclass(frozen=True, eq=False)
class _Appearance:
    """Of pictures. features: (N, C), each level's of unit length. chroma: (N, 2)."""

    features: FArray
    chroma: FArray


class AppearanceSimilarity:
    """How much detections look like a mesh. What it keeps of a mesh is made at its first use.

    Raises WeightsError where ImageNet's weights are missing.
    """

    def __init__(self, renderer: Renderer, options: NovelOptions) -> None:
        self.renderer, self.options = renderer, options
        self._body = Lite0()
        load_lite0(self._body, lite0_imagenet())
        self._known: WeakKeyDictionary[ObjectModel, tuple[TemplateSearch, _Appearance]] = WeakKeyDictionary()

    def of(
        self, view: View, model: ObjectModel, proposals: Sequence[Detection], appearance: _Appearance
    ) -> list[float]:
        """Of each proposal, in [0, 1], in two rounds: the template search is for the best by features and chroma; the
        others get 0."""
        search, known = self._of(model)
        options = self.options
        cosine = np.maximum(0.0, (appearance.features @ known.features.T).max(axis=1) / len(LEVELS)).astype(np.float64)
        apart = np.linalg.norm(known.chroma[None] - appearance.chroma[:, None], axis=2).min(axis=1)
        own = np.array([proposal.score for proposal in proposals])
        weight = np.exp(-apart / options.chroma) * own**options.objectness
        screen = cosine * weight
        scores = np.zeros(len(proposals))
        for k in np.argsort(-screen, kind="stable")[: options.screened]:
            first = search.search(view, proposals[k], 1)
            shape = max(0.0, first[0].score) / (1 + search.options.colour) if first else 0.0
            scores[k] = min(1.0, (shape + options.features * cosine[k]) / (1 + options.features)) * weight[k]
        return [float(score) for score in scores]

    def _of(self, model: ObjectModel) -> tuple[TemplateSearch, _Appearance]:
        if model not in self._known:
            pictures = self._pictures(model)
            self._known[model] = (
                TemplateSearch(model, self.renderer),
                _Appearance(self._features(pictures), _chroma(pictures)),
            )
        return self._known[model]

    def appearance(self, view: View, proposals: Sequence[Detection]) -> _Appearance:
        """The features and colours of N proposals' crops, to be compared with each model's views."""
        crops = [self._crop(view, proposal) for proposal in proposals]
        return _Appearance(self._features(crops), _chroma(crops))

    def _pictures(self, model: ObjectModel) -> list[View]:
        distance = 4.0 * model.diameter
        focal = 0.9 * SIDE * distance / model.diameter
        camera = Camera(focal, focal, 0.5 * SIDE - 0.5, 0.5 * SIDE - 0.5, SIDE, SIDE)
        rotations = [view_rotation(d) for d in fibonacci_sphere(self.options.views)]
        poses = [Pose(R, np.array([0, 0, distance])) @ model.T_ctr_obj for R in rotations]
        drawn = self.renderer.render(model, poses, camera, light=Light(), coords=False)
        return [view for view in drawn if view.mask is not None and view.mask.any()]

    def _crop(self, view: View, proposal: Detection) -> View:
        zoom = zoom_to_box(view.camera, proposal.box, (SIDE, SIDE), enlarge=MARGIN)
        return view.with_mask(proposal.mask).zoomed(zoom)

    def _features(self, pictures: Sequence[View]) -> FArray:
        """ImageNet's features over each silhouette, (N, C), each level's of unit length."""
        images = torch.from_numpy(np.stack([p.image for p in pictures])).permute(0, 3, 1, 2).float() / 255
        masks = torch.from_numpy(np.stack([p.mask for p in pictures if p.mask is not None])).float()[:, None]
        pooled = []
        with torch.inference_mode():
            levels = self._body((images - LITE0_MEAN) / LITE0_STD * masks)
            for level, stride in LEVELS.items():
                share = F.avg_pool2d(masks, stride)
                pooled.append((levels[level] * share).sum((2, 3)) / (share.sum((2, 3)) + 1e-6))
        return np.asarray(torch.cat([F.normalize(p, dim=1) for p in pooled], 1).numpy(), np.float32)


class NovelDetector:
    """A Detector for meshes that it has never seen.

    Raises ConfigError where the network is not class-agnostic, WeightsError where ImageNet's weights are missing.
    """

    def __init__(self, detector: TrainedDetector, renderer: Renderer, options: NovelOptions = NovelOptions()) -> None:
        if not detector.config.novel:
            raise ConfigError(
                f"this detector was trained for {', '.join(detector.config.classes)}, not for any object: pass "
                "class-agnostic weights, or use it for its own classes."
            )
        self.detector, self.renderer, self.options = detector, renderer, options
        self.similarity = AppearanceSimilarity(renderer, options)
        self._textured: dict[ObjectModel, FeatureSearch] = {}

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """The instances of the models, those found by local features first; with no models, objects of any kind."""
        proposals = self.propose(view)
        if not models:
            return proposals
        known = [each for model in models for each in self._by_features(view, model)]
        if not proposals:
            return known
        appearance = self.similarity.appearance(view, proposals)
        found = [each for model in models for each in self._instances(view, model, proposals, appearance)]
        new = [each for each in found if not any(_same_instance(each, other, self.options.overlap) for other in known)]
        return known + ([sharpened(view.image, each) for each in new] if self.options.sharpen else new)

    def _by_features(self, view: View, model: ObjectModel) -> list[Detection]:
        """Boxes of the instances that local features find; half of the score is reached by the least inliers."""
        if model not in self._textured:
            self._textured[model] = FeatureSearch(model, self.renderer)
        search = self._textured[model]
        matches, size = search.options.min_matches, view.camera.size
        return [
            Detection(
                clipped(each.box, size), None, each.inliers / (each.inliers + matches), model.name, Source.FEATURES
            )
            for each in search.search(view)[: self.options.max_detections]
        ]

    def propose(self, view: View) -> list[Detection]:
        """Objects of any kind, by falling score."""
        options = self.options
        width, height = self.detector.config.use_size
        sizes = [(round(scale * width), round(scale * height)) for scale in options.scales]
        least, most = options.min_proposal_score, options.proposals
        found = [find(self.detector, view.image, min_score=least, max_detections=most, size=size) for size in sizes]
        boxes = np.concatenate([each.boxes for each in found])
        scores = np.concatenate([each.scores for each in found])
        masks = np.concatenate([each.masks for each in found])
        kept = torchvision().ops.nms(torch.from_numpy(boxes), torch.from_numpy(scores), options.same).numpy()
        return [
            Detection((float(x0), float(y0), float(x1), float(y1)), mask, float(score), None, Source.NOVEL)
            for (x0, y0, x1, y1), mask, score in zip(boxes[kept], masks[kept], scores[kept], strict=True)
        ]

    def similarities(self, view: View, model: ObjectModel, proposals: Sequence[Detection]) -> list[float]:
        """How much each proposal looks like the mesh, in [0, 1]."""
        return (
            self.similarity.of(view, model, proposals, self.similarity.appearance(view, proposals)) if proposals else []
        )

    def _instances(
        self, view: View, model: ObjectModel, proposals: Sequence[Detection], appearance: _Appearance
    ) -> list[Detection]:
        scores = self.similarity.of(view, model, proposals, appearance)
        kept: list[Detection] = []
        masks: list[NDArray[np.bool_]] = []
        for k in np.argsort(np.negative(scores), kind="stable"):
            proposal, score = proposals[int(k)], scores[int(k)]
            if score < self.options.min_score or len(kept) == self.options.max_detections:
                break
            mask = proposal.mask
            assert mask is not None
            if all(mask_iou(mask, other) < self.options.overlap for other in masks):
                masks.append(mask)
                kept.append(Detection(proposal.box, proposal.mask, score, model.name, Source.NOVEL))
        return kept


class SimilarityDetector:
    """A detector that was trained for its meshes, whose detections' scores also say how much they look like them: the
    log odds grow by `WEIGHT` times what the similarity is above `USUAL`. Meshes without colours keep the detector's
    scores.

    min_score: score of a detection. max_detections: of one mesh, 0 = all.
    """

    def __init__(self, detector: MaskRCNN, renderer: Renderer, min_score: float, max_detections: int = 0) -> None:
        self.detector, self.min_score, self.max_detections = detector, min_score, max_detections
        self.similarity = AppearanceSimilarity(renderer, NovelOptions(objectness=0.0))

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """Instances of the models, by falling score; with no models, of all classes by the detector's own scores.
        Raises ConfigError where a model is no class."""
        found = self.detector.detect(view, models)
        for model in models:
            mine = [k for k, each in enumerate(found) if each.label == model.name]
            if not mine or not model.coloured:
                continue
            proposals = [found[k] for k in mine]
            similarities = self.similarity.of(view, model, proposals, self.similarity.appearance(view, proposals))
            for k, similarity in zip(mine, similarities, strict=True):
                found[k] = replace(found[k], score=with_similarity(found[k].score, similarity))
        left: dict[str | None, int] = {}
        kept = []
        for each in sorted(found, key=lambda d: -d.score):
            left[each.label] = left.get(each.label, self.max_detections or len(found)) - 1
            if each.score >= self.min_score and left[each.label] >= 0:
                kept.append(each)
        return kept


def _chroma(pictures: Sequence[View]) -> FArray:
    """The median a and b (CIELAB, 8 bits) over each silhouette, (N, 2)."""
    rows = []
    for picture in pictures:
        mask = picture.mask
        inside = mask if mask is not None and mask.any() else np.ones(picture.image.shape[:2], np.bool_)
        rows.append(np.median(cv2.cvtColor(picture.image, cv2.COLOR_RGB2LAB)[inside][:, 1:], axis=0))
    return np.asarray(rows, np.float32).reshape(-1, 2)


def clipped(box: Box, size: tuple[int, int]) -> Box:
    """A box's part (edges) in a picture of that (width, height)."""
    x0, y0, x1, y1 = np.clip(box, 0, [*size, *size])
    return float(x0), float(y0), float(x1), float(y1)


def _same_instance(a: Detection, b: Detection, overlap: float) -> bool:
    """Whether two detections of one mesh have boxes that lie on each other."""
    return a.label == b.label and bool(box_iou(a.box, b.box) >= overlap)


def make_detector(
    name: str | None,
    models: Sequence[ObjectModel],
    *,
    min_score: float | None = None,
    max_detections: int = 3,
    doubtful: bool = False,
) -> tuple[Detector, tuple[str, ...]]:
    """A network's Detector and the names that its detections may have. name: "novel" (the default), "coco", or a
    trained detector's file or folder. max_detections: of a mesh (of the novel detector only where poses do not verify
    them: then it gives `SCREENED`). doubtful: whether the detections are verified by
    poses, so that trained detectors' doubtful ones are wanted too, and no more than ``max_detections``. Raises
    WeightsError, ConfigError.
    """
    file = SHIPPED if name is None or name == ANY else Path(name)
    trained = load_coco() if name == COCO else load_detector(file)
    if not trained.config.novel:
        names = tuple(m.name for m in models) or trained.config.classes
        usual = DOUBTFUL if doubtful else 0.5
        min_score = usual if min_score is None else min_score
        if name == COCO:
            return MaskRCNN(trained, min_score, max_detections if doubtful else 0), names
        return SimilarityDetector(
            MaskRCNN(trained, min(min_score, DOUBTFUL)), Renderer(), min_score, max_detections if doubtful else 0
        ), names

    options = (
        NovelOptions(max_detections=max_detections)
        if min_score is None
        else NovelOptions(min_score=min_score, min_proposal_score=min_score, max_detections=max_detections)
    )
    if doubtful and models and min_score is None:  # poses choose among many
        options = TO_VERIFY
    elif models and min_score is not None:
        options = NovelOptions(min_score=min_score, max_detections=max_detections)
    return NovelDetector(trained, Renderer(), options), tuple(m.name for m in models) or trained.config.classes
