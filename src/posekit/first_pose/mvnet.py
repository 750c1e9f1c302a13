"""First poses, a mask and a score from the matching MV-Net."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from posekit.align.pnp import PnpConfig, solve_pnp
from posekit.camera import Camera, Zoom, box_mask
from posekit.errors import WeightsError
from posekit.first_pose.hypotheses import FirstPoseSearch, Hypothesis
from posekit.first_pose.view_bank import DISTANCE, TURNS, ViewBank
from posekit.geometry import Pose, cube_views, quat_to_rotation, rotation_angle, rotation_between, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.nets.inputs import to_input
from posekit.nets.mvnet import CELL, GRID, NONE, VIEW, Encoded, Matches, MatchingMVNet, rgb_input, view_input
from posekit.nets.pose_delta import PoseDelta, apply_delta
from posekit.nets.weights import Networks
from posekit.render import Renderer
from posekit.results import Detection
from posekit.view import View
from posekit.zoom import frontal_camera, frontal_pose, zoom_to_box

Array = NDArray[np.float64]
FArray = NDArray[np.float32]


@dataclass(frozen=True)
class MatchingOptions:
    """How MV-Net's outputs become poses."""

    enlarge: float = 1.35  # the crop's size in boxes, as in training
    likely: float = 0.08  # least probability of a correspondence;
    present: float = 0.4  # that a cell of the crop is in a view at all
    error_px: float = 6.0  # how far off an inlier may be, in pixels of the crop
    inliers: int = 8  # fewest that make a pose
    pooled: int = 3  # best views whose correspondences are also solved together
    apart: float = float(np.deg2rad(15.0))  # least angle between two hypotheses
    refine: PnpConfig = PnpConfig(iterations=8, min_points=6)  # the last solve


@dataclass(frozen=True, eq=False)
class Examined:
    """MV-Net's output for a detection. hypotheses: best first. mask: bool (H, W), the visible object in the photograph.
    existence_score: probability that the box shows the mesh."""

    hypotheses: list[Hypothesis]
    mask: NDArray[np.bool_]
    existence_score: float


@dataclass(frozen=True, eq=False)
class MatchingOutput:
    """Of the network for one crop. templates: int64 (k,). matches: float32 arrays without the batch's axis, named as in
    `Matches`."""

    templates: NDArray[np.int64]
    cells: FArray
    offsets: FArray
    silhouettes: FArray
    scores: FArray
    turns: FArray
    presence: float

    @classmethod
    def of(cls, templates: NDArray[np.int64], matches: Matches) -> MatchingOutput:
        """matches: of a batch of one."""
        cells, offsets, silhouettes, scores, turns, presence = (t[0].float().cpu().numpy() for t in matches)
        return cls(templates, cells, offsets, silhouettes, scores, turns, float(presence))


@dataclass(frozen=True, eq=False)
class _Points:
    """Correspondences. points: (N, 3) metres in ``ctr``. pixels: (N, 2) of the crop. weight: (N,), probabilities."""

    points: Array
    pixels: Array
    weight: Array

    @classmethod
    def joined(cls, parts: Sequence[_Points]) -> _Points:
        return cls(np.concatenate([p.points for p in parts]), np.concatenate([p.pixels for p in parts]),
                   np.concatenate([p.weight for p in parts]))  # fmt: skip


def mvnet_search(model: ObjectModel, networks: Networks, renderer: Renderer) -> FirstPoseSearch:
    """First poses by the MV-Net that the weights hold, of either preset. Raises WeightsError where they hold none."""
    if isinstance(networks.mvnet, MatchingMVNet):
        return MatchingSearch(model, networks.mvnet, renderer)
    return MVNetSearch(model, networks, renderer)


class MVNetSearch:
    """The paper's first pose: MV-Net compares the crop with the six views of a cube's faces (section 3.2).

    The views are rendered once per mesh, each as a crop round its own box would show it. The answer is relative to
    the frontal view, placed at the detection box's centre, at the depth at which it looks as large in the crop as it
    was rendered: so the box's size gives the first depth.
    """

    def __init__(self, model: ObjectModel, networks: Networks, renderer: Renderer) -> None:
        if networks.mvnet is None:
            raise WeightsError(
                f"the {networks.preset} weights {networks.digest} hold no trained MV-Net: use --init templates."
            )
        self.model, self.size, self.mvnet = model, networks.size, networks.mvnet
        self.rotations = cube_views()
        self.camera, self.distance = frontal_camera(model, networks.size)
        poses = [Pose(R, np.array([0, 0, self.distance])) @ model.T_ctr_obj for R in self.rotations]
        views = renderer.render(model, poses, self.camera, coords=False)
        self.device = networks.device
        self.views = torch.from_numpy(np.stack([to_input(v.image, v.mask) for v in views])).to(self.device)

    def search(self, view: View, detection: Detection, count: int) -> list[Hypothesis]:
        """One first pose; ``count`` is an upper bound, as for every search. Empty where it lies behind the camera."""
        mask = detection.mask if detection.mask is not None else box_mask(detection.box, view.camera.size)
        crop = view.with_mask(mask).zoomed(zoom_to_box(view.camera, detection.box, self.size))
        observed = torch.from_numpy(to_input(crop.image, crop.mask))[None].to(self.device)
        with torch.inference_mode():
            out = self.mvnet(observed, self.views[None])
        quat_wxyz, v = (x[0].double().cpu().numpy() for x in (out.quat_wxyz, out.v))
        delta = PoseDelta(quat_to_rotation(quat_wxyz), v)
        target = apply_delta(self.frontal(crop.camera), delta, crop.camera.fx)
        if not np.isfinite(target.matrix).all() or target.t[2] < 0.6 * self.model.diameter:
            return []
        T_cam_view = Pose.rotation(crop.R_view_cam.T)
        return [Hypothesis(T_cam_view @ target @ self.model.T_ctr_obj, 1.0)][:count]

    def frontal(self, crop_camera: Camera) -> Pose:
        """The ``T_view_ctr`` to which MV-Net's answer is relative."""
        return frontal_pose(self.camera, self.distance, crop_camera)


class MatchingSearch:
    """First poses of one mesh by a trained `MatchingMVNet`; its views are encoded once."""

    def __init__(self, model: ObjectModel, mvnet: MatchingMVNet, renderer: Renderer,
                 options: MatchingOptions = MatchingOptions()) -> None:  # fmt: skip
        self.model, self.mvnet, self.options = model, mvnet, options
        self.bank = ViewBank.of(model, renderer)
        self.rotations = self.bank.template_rotations
        self.device = next(mvnet.parameters()).device
        pictures = torch.from_numpy(self.bank.templates())
        with torch.inference_mode():
            chunks = [mvnet.encode(view_input(part.to(self.device))) for part in pictures.split(VIEW)]
        self.encoded = Encoded(*(torch.cat(parts) for parts in zip(*chunks, strict=True)))

    def search(self, view: View, detection: Detection, count: int) -> list[Hypothesis]:
        """The best ``count`` first poses for a detection's box, best first; its mask is not used."""
        return self.examine(view, detection, count).hypotheses

    def examine(self, view: View, detection: Detection, count: int) -> Examined:
        """As `search`, with the mask and the existence score."""
        zoom = zoom_to_box(view.camera, detection.box, self.mvnet.config.size, enlarge=self.options.enlarge)
        output = self.output(view.zoomed(zoom))
        found: list[Hypothesis] = []
        for pose, score in self._candidates(output, zoom.camera):
            if all(rotation_angle(pose.R.T @ h.T_cam_obj.R) > self.options.apart for h in found):
                found.append(Hypothesis(pose, score))
            if len(found) == count:
                break
        back = Pose.rotation(zoom.R_view_cam.T)
        placed = [Hypothesis(back @ h.T_cam_obj @ self.model.T_ctr_obj, h.score) for h in found]
        presence = 1.0 / (1.0 + float(np.exp(-np.clip(output.presence, -30, 30))))
        return Examined(placed, photo_mask(output.silhouettes[0], zoom), presence)

    def output(self, crop: View) -> MatchingOutput:
        """Run the network on a crop of its size."""
        observed = rgb_input(torch.from_numpy(crop.image)[None].to(self.device))
        with torch.inference_mode():
            seen = self.mvnet.observe(observed)
            logits = self.mvnet.select(seen, *(t[None] for t in self.encoded[1:]))
            best = logits[0].topk(min(self.mvnet.kept, len(self.rotations))).indices
            matches = self.mvnet.compare(seen.fine, seen.tokens, self.encoded.tokens[best][None])
        return MatchingOutput.of(best.cpu().numpy(), matches)

    def _candidates(self, output: MatchingOutput, camera: Camera) -> list[tuple[Pose, float]]:
        """``T_crop_ctr`` and score: solved where a view has enough inliers, else composed; best first."""
        found = [self._correspondences(output, row) for row in range(len(output.templates))]
        every = _Points.joined(found)
        probability = 1 / (1 + np.exp(-output.scores.astype(np.float64)))
        order = np.argsort(-probability)
        poses = [(self._solved(found[row], camera) or self._composed(output, int(row), camera), probability[row])
                 for row in order]  # fmt: skip
        together = self._solved(_Points.joined([found[row] for row in order[: self.options.pooled]]), camera)
        if together is not None:
            poses.append((together, probability[order[0]]))
        usable = [(pose, share) for pose, share in poses if pose.t[2] > 0.6 * self.model.diameter]
        scored = [(pose, self._support(pose, every, camera) + 0.2 * float(share)) for pose, share in usable]
        return sorted(scored, key=lambda pair: -pair[1])

    def _correspondences(self, output: MatchingOutput, row: int) -> _Points:
        """Of one view, from the cells that are more likely in it than not and lie on the mesh there."""
        logits = output.cells[row].astype(np.float64)
        share = np.exp(logits - logits.max(1, keepdims=True))
        share /= share.sum(1, keepdims=True)
        cell = share[:, :NONE].argmax(1)
        weight = share[np.arange(len(cell)), cell]
        offset = output.offsets[row].reshape(2, -1).T.clip(-0.75, 0.75)
        place = (np.stack([cell % GRID, cell // GRID], axis=1) + 0.5 + offset) * CELL - 0.5
        u, v = np.rint(place).astype(int).clip(0, VIEW - 1).T
        points = self.bank.template_coords(int(output.templates[row]))[v, u].astype(np.float64)
        there = 1.0 - share[:, NONE] > self.options.present
        kept = there & (weight > self.options.likely) & (np.abs(points).sum(1) > 0)
        columns = self.mvnet.columns
        index = np.arange(len(cell))
        pixels = np.stack([index % columns, index // columns], axis=1) * CELL + 0.5 * (CELL - 1)
        return _Points(points[kept] * self.model.diameter, pixels[kept], weight[kept])

    def _solved(self, found: _Points, camera: Camera) -> Pose | None:
        """By random samples of the correspondences, then all inliers weighted; None where there are too few."""
        if len(found.weight) < self.options.inliers:
            return None
        cv2.setRNGSeed(0)
        try:
            ok, rotation, t, inliers = cv2.solvePnPRansac(
                found.points, found.pixels, camera.K, None, iterationsCount=150, flags=cv2.SOLVEPNP_EPNP,
                reprojectionError=self.options.error_px, confidence=0.995)  # fmt: skip
        except cv2.error:
            return None
        if not ok or inliers is None or len(inliers) < self.options.inliers or not np.isfinite(t).all():
            return None
        start = Pose(so3_exp(rotation.ravel()), t.ravel())
        if start.t[2] < 0.6 * self.model.diameter:
            return None
        kept = inliers.ravel()
        scale = np.full(len(kept), 0.5 * self.options.error_px)
        points, pixels, weight = found.points[kept], found.pixels[kept], found.weight[kept]
        return solve_pnp(points, pixels, weight, scale, camera, start, self.options.refine) or start

    def _composed(self, output: MatchingOutput, row: int, camera: Camera) -> Pose:
        """The view turned in the picture, as large and where the amodal silhouette is."""
        template = int(output.templates[row])
        mask = np.rot90(self.bank.pictures[template // TURNS, ..., 3], template % TURNS) > 0
        drawn = self.bank.template_camera(template)
        turn = float(np.arctan2(output.turns[row, 1], output.turns[row, 0]))
        c, s = np.cos(turn), np.sin(turn)
        area, centre = _extent(output.silhouettes[1], camera, self.options.enlarge)
        scale = np.sqrt(area / max(1, mask.sum()))
        rows, columns = np.nonzero(mask)
        beside = np.array([columns.mean() - drawn.cx, rows.mean() - drawn.cy]) if rows.size else np.zeros(2)
        depth = DISTANCE * self.model.diameter * camera.fx / (drawn.fx * scale)
        t = camera.backproject(centre - scale * np.array([[c, -s], [s, c]]) @ beside, depth)
        return Pose(rotation_between([0, 0, 1], t) @ so3_exp([0, 0, turn]) @ self.rotations[template], t)

    def _support(self, pose: Pose, found: _Points, camera: Camera) -> float:
        """Share of all views' correspondences, weighted, that a pose explains."""
        if not found.weight.size:
            return 0.0
        points = pose.apply(found.points)
        if points[:, 2].min() < 1e-6:
            return 0.0
        error = np.linalg.norm(camera.project(points) - found.pixels, axis=1) / self.options.error_px
        return float((found.weight / (1 + error**2)).sum() / found.weight.sum())


def _extent(logits: FArray, camera: Camera, enlarge: float) -> tuple[float, Array]:
    """Area in pixels of the crop and middle (2,) of a silhouette (H/4, W/4); where it is empty, those of the box."""
    on = logits > 0
    step = camera.width / logits.shape[1]
    if on.sum() < 4:
        side = min(camera.width, camera.height) / enlarge
        return 0.6 * side * side, np.array([camera.cx, camera.cy])
    rows, columns = np.nonzero(on)
    middle = (np.array([columns.mean(), rows.mean()]) + 0.5) * step - 0.5
    return float(on.sum()) * step * step, middle


def photo_mask(logits: FArray, zoom: Zoom) -> NDArray[np.bool_]:
    """A silhouette's logits (H/4, W/4) in the crop as a mask of the photograph's size."""
    small = Zoom(zoom.source, zoom.camera.resized(logits.shape[1], logits.shape[0]), zoom.R_view_cam)
    share = (1 / (1 + np.exp(-logits.clip(-30, 30)))).astype(np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(share, small.homography, zoom.source.size, flags=flags) > 0.5)
