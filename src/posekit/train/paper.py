"""The paper's recipe: MV-Net and SV-Net trained together, end to end (section 3.4, equations 1 and 2).

MV-Net's first estimate renders SV-Net's first sample, each of SV-Net's outputs the next one, detached: SV-Net learns
to correct what the networks get wrong. Where a first estimate is more than 25 degrees off, a sample with a small random
rotation takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.utils.data import IterableDataset

from posekit.camera import Camera, Zoom
from posekit.geometry import Pose, nearest_rotation, quat_to_rotation, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.nets.inputs import images_to_tensor
from posekit.nets.losses import mvnet_loss, svnet_loss
from posekit.nets.paper import PaperMVNet, PaperSVNet
from posekit.nets.pose_delta import PoseDelta, apply_delta, delta_between
from posekit.nets.weights import Networks
from posekit.render import Renderer
from posekit.train.config import TrainConfig
from posekit.train.data.crop_stream import Catalogue, SceneStream
from posekit.train.data.crops import Frontal, disturbed_pose, rgba_of, view_of
from posekit.train.data.stream import Batch
from posekit.train.sources import Sources
from posekit.train.task import PoseTask
from posekit.zoom import frontal_pose, zoom_to_pose

ITERATIONS = 3
WORST_START = float(np.deg2rad(25.0))
MEASURED = 20  # batches that the statistics are measured on


@dataclass(frozen=True, eq=False)
class _Scene:
    """One sample of a batch, back in the library's own terms; poses are ``T_view_ctr``."""

    picture: NDArray[np.uint8]
    camera: Camera
    truth: Pose
    model: ObjectModel
    number: int


@dataclass(frozen=True, eq=False)
class _Crop:
    """SV-Net's sample: source, the pose in the zoomed view; delta, from it to the truth; uint8 (H, W, 4) pictures."""

    zoom: Zoom
    source: Pose
    delta: PoseDelta
    observed: NDArray[np.uint8] | None = None
    rendered: NDArray[np.uint8] | None = None


class PaperModule(nn.Module):
    """A batch in, the loss out: MV-Net's, and SV-Net's after each rendering."""

    def __init__(self, nets: nn.ModuleDict, models: Sequence[ObjectModel], size: tuple[int, int], views: int) -> None:
        super().__init__()
        self.nets, self.models, self.size, self.views = nets, models, size, views
        self._renderer: Renderer | None = None
        self._frontals: dict[int, tuple[Frontal, Tensor]] = {}

    def forward(self, batch: Batch, seed: int) -> tuple[Tensor, dict[str, float]]:
        """The loss of a batch and its parts; seed: of the poses that are drawn."""
        svnet, mvnet = self.nets["svnet"], self.nets["mvnet"]
        assert isinstance(svnet, PaperSVNet) and isinstance(mvnet, PaperMVNet)
        rng = np.random.default_rng(seed)
        scenes = unpack(batch, self.models)
        device = batch["observed"].device
        views = torch.stack([self._frontal(scene.number)[1] for scene in scenes]).to(device)
        first = mvnet(images_to_tensor(batch["observed"]), views)
        loss_m = mvnet_loss(first, mvnet.heads, batch["mv_quat_wxyz"], batch["mv_v"], self.views)
        poses = [self._first_pose(scene, batch, i, first.quat_wxyz, first.v) for i, scene in enumerate(scenes)]
        kept = [is_near(pose, scene, WORST_START) for pose, scene in zip(poses, scenes, strict=True)]
        poses = [pose if near else disturbed_pose(scene.truth, scene.model.diameter, rng)
                 for pose, near, scene in zip(poses, kept, scenes, strict=True)]  # fmt: skip
        parts = {"mv_loss": float(loss_m.detach()), "mv_kept": float(np.mean(kept))}
        loss = loss_m
        for k in range(ITERATIONS):
            crops = [self._crop(scene, pose) for scene, pose in zip(scenes, poses, strict=True)]
            observed, rendered, quat, v, angle = (x.to(device) for x in _stacked(crops))
            found = svnet(observed, rendered)
            loss_s = svnet_loss(found, svnet.heads, quat, v, angle)
            loss = loss + loss_s
            parts |= {
                f"sv_loss_{k + 1}": float(loss_s.detach()),
                f"angle_{k + 1}_deg": float(torch.rad2deg(angle.mean())),
            }
            answers = zip(scenes, crops, _deltas(found.quat_wxyz, found.v), strict=True)
            poses = [self._next(scene, crop, delta, rng) for scene, crop, delta in answers]
        return loss, parts

    @property
    def renderer(self) -> Renderer:
        """Made at the first step, after the worker processes were forked."""
        if self._renderer is None:
            self._renderer = Renderer()
        return self._renderer

    def _frontal(self, number: int) -> tuple[Frontal, Tensor]:
        """MV-Net's views of an object, and as the network takes them (6, 4, H, W)."""
        if number not in self._frontals:
            frontal = Frontal.of(self.models[number], self.renderer, self.size)
            self._frontals[number] = frontal, images_to_tensor(torch.from_numpy(frontal.views))
        return self._frontals[number]

    def _first_pose(self, scene: _Scene, batch: Batch, i: int, quat: Tensor, v: Tensor) -> Pose:
        """MV-Net's estimate in the scene's frame."""
        frontal, _ = self._frontal(scene.number)
        focal = float(batch["focal"][i])
        crop = Camera(focal, focal, 0.5 * self.size[0] - 0.5, 0.5 * self.size[1] - 0.5, *self.size)
        (delta,) = _deltas(quat[i : i + 1], v[i : i + 1])
        target = apply_delta(frontal_pose(frontal.camera, frontal.distance, crop), delta, focal)
        return Pose.rotation(batch["turn"][i].double().cpu().numpy().T) @ target

    def _crop(self, scene: _Scene, pose: Pose) -> _Crop:
        """Zoom to a pose and render the object there."""
        crop = zoomed(scene, pose, self.size)
        T_view_obj = crop.source @ scene.model.T_ctr_obj
        (drawn,) = self.renderer.render(scene.model, [T_view_obj], crop.zoom.camera, coords=False)
        observed = view_of(scene.picture, scene.camera).zoomed(crop.zoom)
        return replace(crop, observed=rgba_of(observed), rendered=rgba_of(drawn))

    def _next(self, scene: _Scene, crop: _Crop, delta: PoseDelta, rng: np.random.Generator) -> Pose:
        """The next iteration's start: the output, turned back into the scene's frame, unless it is lost."""
        updated = apply_delta(crop.source, delta, crop.zoom.camera.fx)
        found = Pose.rotation(crop.zoom.R_view_cam.T) @ updated
        return found if is_near(found, scene, np.pi) else disturbed_pose(scene.truth, scene.model.diameter, rng)


def zoomed(scene: _Scene, pose: Pose, size: tuple[int, int]) -> _Crop:
    """The window of ``size`` round a pose, and what there is to learn in it, without pictures."""
    zoom = zoom_to_pose(scene.camera, pose, scene.model.hull_ctr, size)
    turn = Pose.rotation(zoom.R_view_cam)
    source = turn @ pose
    return _Crop(zoom, source, delta_between(source, turn @ scene.truth, zoom.camera.fx))


def _stacked(crops: Sequence[_Crop]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """observed, rendered (B, 4, H, W); quat_wxyz (B, 4), v (B, 3), angle (B,), the truth."""
    pictures = (np.stack([getattr(c, name) for c in crops]) for name in ("observed", "rendered"))
    observed, rendered = (images_to_tensor(torch.from_numpy(p)) for p in pictures)
    return observed, rendered, *_targets([c.delta for c in crops])


def _targets(deltas: Sequence[PoseDelta]) -> tuple[Tensor, Tensor, Tensor]:
    """quat_wxyz (B, 4), w >= 0; v (B, 3); angle (B,)."""
    quat = np.stack([Pose.rotation(d.R).quat_wxyz for d in deltas]).astype(np.float32)
    v = np.stack([d.v for d in deltas]).astype(np.float32)
    return torch.from_numpy(quat), torch.from_numpy(v), torch.tensor([d.angle for d in deltas], dtype=torch.float32)


def unpack(batch: Batch, models: Sequence[ObjectModel]) -> list[_Scene]:
    """A `SceneStream`'s batch as single scenes."""
    pictures, cameras = batch["scene"].cpu().numpy(), batch["camera"].double().cpu().numpy()
    matrices, numbers = batch["pose"].double().cpu().numpy(), batch["object"].tolist()
    height, width = pictures.shape[1:3]
    return [
        _Scene(
            picture, Camera(fx, fy, cx, cy, width, height), Pose(nearest_rotation(m[:3, :3]), m[:3, 3]), models[k], k
        )
        for picture, (fx, fy, cx, cy), m, k in zip(pictures, cameras.tolist(), matrices, numbers, strict=True)
    ]


def is_near(pose: Pose, scene: _Scene, angle: float) -> bool:
    """Whether a pose can be a sample: within ``angle`` radians of the truth, and where its crop shows the object."""
    if not np.isfinite(pose.matrix).all() or pose.t[2] <= 0:
        return False
    ratio = pose.t[2] / scene.truth.t[2]
    beside = np.linalg.norm(pose.t[:2] / pose.t[2] - scene.truth.t[:2] / scene.truth.t[2]) * scene.truth.t[2]
    turned = rotation_angle(pose.R @ scene.truth.R.T)
    inside = 0.5 < ratio < 2.0 and beside < 0.5 * scene.model.diameter and pose.t[2] > 0.6 * scene.model.diameter
    return bool(turned <= angle and inside)


def _deltas(quat: Tensor, v: Tensor) -> list[PoseDelta]:
    quats, vs = quat.detach().double().cpu().numpy(), v.detach().double().cpu().numpy()
    vs[:, 2] = vs[:, 2].clip(-5, 5)  # an untrained head may ask for a depth that overflows
    return [PoseDelta(quat_to_rotation(q), x) for q, x in zip(quats, vs, strict=True)]


class PaperTask(PoseTask):
    """The recipe for the loop."""

    def __init__(self, config: TrainConfig, networks: Networks, sources: Sources, fresh: frozenset[str],
                 catalogue: Catalogue) -> None:  # fmt: skip
        super().__init__(config, networks, sources, fresh, catalogue.models, with_mvnet=True)
        self.catalogue = catalogue
        self.module: nn.Module = PaperModule(self.nets, catalogue.models, networks.size, config.paper.views)

    def stream(self, start: int, rank: int) -> IterableDataset[Batch]:
        """Process ``rank``'s batches from number ``start`` on."""
        return SceneStream(self.config.stream, self.config.seed, self.catalogue, self.sources.photos, start=start,
                           rank=rank)  # fmt: skip

    @property
    def measured(self) -> int:
        """Batches that `prepare` measures: none where the networks are not new."""
        return MEASURED if self.fresh else 0

    def prepare(self, batches: Sequence[Batch]) -> None:
        """Zero mean and unit variance of both networks' targets; SV-Net's from small random disturbances."""
        rng = np.random.default_rng(self.config.seed)
        if "mvnet" in self.fresh:
            quat, v = (torch.cat([b[key] for b in batches]) for key in ("mv_quat_wxyz", "mv_v"))
            self.heads("mvnet").set_statistics(quat, v)
        if "svnet" in self.fresh:
            scenes = [s for b in batches for s in unpack(b, self.catalogue.models)]
            starts = [disturbed_pose(s.truth, s.model.diameter, rng) for s in scenes]
            crops = [zoomed(s, start, self.networks.size) for s, start in zip(scenes, starts, strict=True)]
            quat, v, _ = _targets([crop.delta for crop in crops])
            self.heads("svnet").set_statistics(quat, v)
