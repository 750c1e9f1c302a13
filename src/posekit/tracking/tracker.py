"""Tracker: the last pose seeds the next frame's.

Paper, section 3.4: the first frame is estimated and refined; each next frame starts from the last pose. A predicted
angle above 25 degrees restarts with a new first pose, one below 2 degrees leaves the pose as it is. What goes beyond
the paper, and why, is in docs/tracking.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Lock
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.align.colour_edge import Colours, Tint, contrast, learn, off_colour, outline_lines, unhidden
from posekit.align.gauss_newton import GaussianPose, Lines, Points, Residual, fuse
from posekit.camera import Camera
from posekit.errors import CameraError, ConfigError
from posekit.estimate.estimator import PoseEstimator, nearest_to
from posekit.estimate.instances import SearchOptions, find_instances
from posekit.estimate.refine import crops
from posekit.geometry import Pose, rotation_angle, so3_exp, so3_log
from posekit.mesh.model import ObjectModel
from posekit.nets.pose_delta import apply_delta
from posekit.nets.precision import usable_cores
from posekit.nets.predictor import PairPrediction, Predictor
from posekit.results import Branch, Detection, Estimate, Source
from posekit.tracking.appearance import Appearance, colours_agree
from posekit.tracking.memory import Memory, distinct
from posekit.tracking.points import Keyframe, follow_points, match_texture
from posekit.view import View
from posekit.zoom import zoom_to_pose

TRACKED, UNCERTAIN, LOST = "tracked", "uncertain", "lost"
MASKS, MOTIONS, RUNTIMES = ("colours", "pose", "none"), ("points", "velocity", "none"), ("openvino", "torch")
NEAR = 0.6  # diameters, the least distance of an object's centre that is accepted
# standard deviations of a turn in degrees, a shift in pixels of the crop, and a depth in shares of the distance
GIVEN = (1.0, 0.5, 0.005)  # of a first pose
PREDICTED = (10.0, 8.0, 0.05)  # of the motion between two frames, where they are compared
UNPREDICTED = (6.0, 4.0, 0.02)  # of that motion, when nothing else is known about it
LEAST_STD = (0.5, 0.15, 0.004)  # of any pose, at least: errors last over many frames
CORRELATED = 25.0  # number of correspondences whose errors are correlated
CLEAR = 0.3  # contrast of an outline that is evidence by itself
MOST_GROWN = 1.5  # pixels that an outline may look larger or smaller
# pixels of the crop: a disagreement of the network alone that halves its weight, and the largest that counts; share of
# a frame in what is known of it
BIASED, MOST_BIASED, BIAS_RATE = 1.0, 2.0, 0.2
ANGLE_OF_DOUBLE = math.radians(4.0)  # predicted angle at which that number doubles
TINT_RATE = 0.15  # weight of a frame in the running tint
# contrast of a silhouette, to the usual one, below which turned poses are tried too; by how much they are turned
# contrast by which a turned pose has to be better: part of an object that is being hidden lowers it, too
LESS_SEPARATED, TURNED, TURNED_MARGIN = 0.88, math.radians(25.0), 0.05
COARSE = 1500  # of the mesh that is drawn where the outline is looked for in smaller crops
FACES = 6000  # of the mesh that is drawn: a crop shows no more
LEAST_SCALE, KNEE = 0.5, 2.5  # pixels, no correspondence is more exact; standard deviations


# of a lost object that is looked for by memory: standard deviations as above of where it is looked for; candidates by
# colours, and those that are compared; the contrast of its silhouette as a share of what it was when it was followed
REGAINED = (15.0, 12.0, 0.15)
CANDIDATES, COMPARED, LEAST_CONTRAST, PLACE_CONTRAST = 8, 3, 0.7, 0.5
STEPS = 4  # comparisons of a frame with such a pose at most; one more follows the first that bears it out
SURE = 0.6  # share of a silhouette with the object's colours from which on a frame is remembered

# what contradicts a pose: less than this share of its outline within NEAR_PX pixels of where the colours put it; less
# than this share of the first silhouette's contrast; a predicted angle (degrees) and a median distance of the network's
# correspondences (pixels) above these and above TWICE what they usually are. CONTRADICTED of the four are needed.
# Chosen on made sequences: docs/decisions/0026
BORNE_OUT, NEAR_PX, LESS_CONTRAST, WIDE_DEG, WIDE_PX, TWICE = 0.5, 1.5, 0.7, 10.0, 1.5, 2.0
CONTRADICTED, USUAL_RATE = 2, 0.1
# what `Tracker._recalled` changes
FOLLOWED = ("_state", "_before", "_colours", "_tint", "_motion", "_doubts", "_separated", "_separated_first",
            "_separated_usual", "_usual", "_bias", "_waiting", "_contradictions", "_contradicted")  # fmt: skip

_ONE_SEARCH = Lock()  # detectors and estimators are shared by trackers, and searches take a core each


class Finder(Protocol):
    """A detector of objects in a photograph, such as posekit.detect's and posekit.detect.novel's detectors."""

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """Instances of the models in the picture, by falling score."""


@dataclass(frozen=True)
class TrackConfig:
    """How a `Tracker` follows an object."""

    # restart_deg, still_deg: predicted angles above which a frame is in doubt, and below which the network leaves the
    # pose to points and outline, both degrees
    restart_deg: float = 25.0
    still_deg: float = 0.0
    converged_deg: float = 2.0  # the predicted angle below which an estimate counts as converged
    again_deg: float = 8.0
    # by which the crops are smaller in which the outline is looked for before a frame is compared, coarse to fine;
    # none: it is not looked for
    scales: tuple[int, ...] = (4, 2, 1)
    margin: float = 0.02  # by which the outline's pose has to separate the colours better than the predicted one
    iterations: int = 1  # comparisons of a frame at most; a second one follows a turn of more than ``again_deg``
    # where a frame's comparison starts: where followed points lead ("points"), the share ``prior`` of the last motion
    # once more ("velocity"), or the last pose ("none")
    motion: str = "points"
    prior: float = 0.7
    # outline, texture: whether the colours' place of the outline counts, and the mesh's texture where the frame shows
    # it
    outline: bool = True
    texture: bool = True
    # what a frame's mask is taken to be: where the silhouette has the object's colours ("colours"), all of it
    # ("pose"), or nothing ("none")
    mask: str = "colours"
    keep: float = 0.7  # share of the information that is kept for the next frame
    min_colour_share: float = 0.3  # share of the silhouette with the object's colours, below which a frame is in doubt
    learn: float = 0.1  # share of a frame in these colours
    least_inside: float = 0.3  # share of the silhouette's box in the picture, likewise
    doubts: int = 3  # frames in doubt in a row after which the object is lost
    search: int = 5  # frames between two attempts to find it
    # whether a lost object is searched beside the loop, in a thread, so that no frame waits for a search; which frame
    # it is found in then depends on the machine's speed. search_share: the share of the time that is searched then, at
    # most. search_age: seconds after which a found pose is too old to be brought to the newest frame
    search_beside: bool = False
    search_share: float = 0.5
    search_age: float = 10.0
    # whether what hides an object is told by the colours that the video has shown of it, where the mesh has none, or
    # others than the first frame shows
    appearance: bool = True
    remember: bool = True  # whether views of the followed object are kept, and a lost one is looked for by them
    runtime: str = "openvino"  # of the network

    def __post_init__(self) -> None:
        if not 0 <= self.still_deg < self.restart_deg <= 180:
            raise ConfigError(
                f"the angle that leaves a pose is from 0 on and below the one that restarts, which is at most 180 "
                f"degrees; not {self.still_deg:g} and {self.restart_deg:g}."
            )
        if min(self.iterations, self.doubts, self.search) < 1:
            raise ConfigError("iterations, doubts and search are at least 1.")
        if not all(0 <= share <= 1 for share in (self.prior, self.min_colour_share, self.learn, self.least_inside)):
            raise ConfigError("prior, min_colour_share, learn and least_inside are shares between 0 and 1.")
        if not 0 < self.search_share <= 1 or not self.search_age > 0:
            raise ConfigError("search_share is a share above 0, at most 1, and search_age is above 0 seconds.")
        if not 0 < self.keep <= 1:
            raise ConfigError(f"keep is a share above 0, at most 1, not {self.keep:g}.")
        for name, known in (("mask", MASKS), ("motion", MOTIONS), ("runtime", RUNTIMES)):
            if getattr(self, name) not in known:
                raise ConfigError(f"{name} is one of {', '.join(known)}, not {getattr(self, name)!r}.")


@dataclass(frozen=True, eq=False)
class Tracked:
    """The result for a frame.

    state: "tracked" (the picture bears the pose out), "uncertain" (the pose is a prediction: what the picture shows is
    too little to tell, or contradicts it) or "lost" (no pose). estimate: None where it is lost; its score is the share
    of its silhouette that has the object's colours. restarted: whether this is the first frame after a search rather
    than a continuation of the last frame's pose.
    """

    state: str
    estimate: Estimate | None = None
    restarted: bool = False

    @property
    def T_cam_obj(self) -> Pose | None:
        """The pose, metres; None where the object is not seen."""
        return None if self.estimate is None else self.estimate.T_cam_obj

    @property
    def reliable(self) -> bool:
        """Whether the pose can be used: it is tracked, and its score and predicted angle are those of a reliable
        estimate."""
        return self.state == TRACKED and self.estimate is not None and self.estimate.reliable

    @property
    def angle(self) -> float | None:
        """The predicted rotation error, radians."""
        return None if self.estimate is None else self.estimate.angle


class Tracker:
    """Follows one object from frame to frame. Its memory does not grow with the number of frames.

    camera: of all frames, unless `step` is given another. pose: ``T_cam_obj`` in the first frame, where it is known.
    estimator: of this model; made with the shipped weights where it is not given. detector: finds the object in the
    first frame and when it is lost; without one a lost object is looked for only by what was seen of it while it was
    followed. predictor: in place of the one that ``config.runtime`` names.
    Not thread-safe: one tracker per thread. Raises ConfigError where neither pose nor detector is given.
    """

    def __init__(
        self,
        model: ObjectModel,
        camera: Camera | None = None,
        *,
        pose: Pose | None = None,
        estimator: PoseEstimator | None = None,
        detector: Finder | None = None,
        predictor: Predictor | None = None,
        config: TrackConfig = TrackConfig(),
    ) -> None:
        if pose is None and detector is None:
            raise ConfigError("a tracker needs the first pose, or a detector that finds the object.")
        self.model, self.camera, self.config = model, camera, config
        self.estimator = estimator or PoseEstimator(model)
        self.predictor = predictor or _predictor(self.estimator, config)
        self.renderer, self.detector = self.estimator.renderer, detector
        self._drawn = model.simplified(FACES)
        self._coarse = model.simplified(COARSE)
        self._outline = model.hull_ctr
        self._executor = ThreadPoolExecutor(1, "posekit-network")
        self._last: Tracked | None = None
        self._given = pose  # a first pose that no frame has been compared with
        self._last_pose = pose  # the last ``T_cam_obj`` that was returned, whether or not the object was lost since
        self._state: GaussianPose | None = None  # ``T_cam_ctr``
        self._motion = Pose.identity()  # of the object's centre and axes, from the frame before the last to the last
        self._before: Keyframe | None = None
        self._colours: Colours | None = None
        self._tint: Tint | None = None
        self._doubts = 0
        self._contradictions = self._contradicted = 0  # of the last frame; frames in a row that are contradicted
        self._usual = (0.0, 0.0)  # radians and pixels: the network's angle and its correspondences' distance
        # contrast of the last silhouette, of the first, and of those that the picture bears out, a running mean
        self._separated = self._separated_first = self._separated_usual = 0.0
        self._grown = dict.fromkeys({1, *config.scales}, 0.0)  # pixels, see `_growth`
        self._bias = 0.0  # pixels of the crop: how far the network alone has been from what all evidence gave
        self._waiting = 0  # frames until the next search
        self._memory = Memory(model, self.renderer)
        self._appearance: Appearance | None = None  # where the mesh's colours are wrong
        self._known: _Known | None = None
        self._place: Pose | None = None  # ``T_cam_obj``, where a search's frame has the object's colours
        self._searching: Future[Tracked] | None = None  # of a search beside the loop
        self._searcher: ThreadPoolExecutor | None = None
        self._search_began = self._search_next = 0.0  # seconds of time.monotonic

    @property
    def last(self) -> Tracked | None:
        """The result for the last frame; None before the first one."""
        return self._last

    @property
    def expected(self) -> Pose | None:
        """``T_cam_obj`` in the next frame if the last motion is repeated; None where the object is not followed."""
        if self._state is None or self._searching is not None:  # a search has the state to itself
            return None
        last = self._state.pose
        pose = Pose(self._motion.R @ last.R, last.t + self._motion.t) @ self.model.T_ctr_obj
        return pose if self._in_front(pose) else None

    @property
    def drawn(self) -> ObjectModel:
        """The mesh as it is drawn for a frame: with at most `FACES` faces."""
        return self._drawn

    def step(
        self, image: NDArray[np.uint8], camera: Camera | None = None, valid: NDArray[np.bool_] | None = None
    ) -> Tracked:
        """The object in the next frame. image: uint8 RGB (H, W, 3). valid: as a `View` has it.

        Raises CameraError where no camera is known."""
        self._last = self._step(image, camera, valid)
        return self._last

    def _step(self, image: NDArray[np.uint8], camera: Camera | None, valid: NDArray[np.bool_] | None) -> Tracked:
        chosen = camera or self.camera
        if chosen is None:
            raise CameraError("the tracker was made without a camera: pass one with each frame.")
        view = View(image, chosen, valid=valid)
        if self._given is not None:
            started, pose, self._given = time.perf_counter(), self._given, None
            if self._begin(view, pose, math.radians(GIVEN[0])):
                assert self._before is not None
                prediction, network = self._compared(self._before.seen, self._before.drawn, self._before.visible)
                self._bias = self._disagreement(self._before, prediction, self._before.T_view_ctr)
                self._usual = prediction.angle, self._distance(self._before, prediction, self._before.T_view_ctr)
                timings = {"network": network, "total": time.perf_counter() - started}
                given = self._estimate(view, pose, prediction.angle, 0, 1.0, timings)
                return Tracked(TRACKED, self._on_branch(given, Branch.GIVEN))
        if self._state is not None and self._searching is None:  # a search has the state to itself
            found = self._follow(view, self._state)
            if found is not None:
                state = self._judged(view, found)
                if state == TRACKED:
                    self._remember(view, found)
                elif state == UNCERTAIN and (better := self._better(view)) is not None:
                    return Tracked(TRACKED, self._on_branch(better), restarted=True)
                if state != LOST:
                    return Tracked(state, self._on_branch(found))
            self._reset()
        return self._find_beside(view) if self.config.search_beside else self._find(view)

    # --- following ---

    def _begin(self, view: View, pose: Pose, turn_std: float) -> bool:
        """Start from a first pose; whether the mesh is seen there. turn_std: radians."""
        self._state = self._before = self._colours = None
        if not self._in_front(pose):
            return False
        seen, drawn = self._crops(view, pose)
        assert drawn.mask is not None
        if not (drawn.mask & seen.shown).any():
            return False
        centred = pose @ self.model.T_obj_ctr
        _, shift, depth = GIVEN
        self._state = GaussianPose.about(centred, seen.camera, turn_std, shift, depth)
        visible = unhidden(seen, drawn)
        if (visible & drawn.mask).sum() < 0.15 * drawn.mask.sum():
            visible = np.ones_like(visible)
        self._colours = learn(seen, drawn.mask, visible)
        T_view_ctr = Pose.rotation(seen.R_view_cam) @ centred
        if self._appearance is None and self._to_be_learned(seen, drawn, visible):
            self._appearance = Appearance(self.model.center, self.model.diameter)
        apart, known = self._off_colour(seen, drawn, T_view_ctr)
        self._tint = Tint.of(apart, visible & drawn.mask & known)
        self._before = Keyframe(seen, drawn, T_view_ctr, visible)
        self._separated = self._separated_first = contrast(seen, drawn.mask, self._colours)
        self._separated_usual = self._separated
        self._grown = {scale: self._growth(view, pose, scale) for scale in {1, *self.config.scales}}
        return True

    def _growth(self, view: View, pose: Pose, scale: int) -> float:
        """By how many pixels of a crop that is smaller by ``scale`` the outline that the colours show lies outside that
        of a first pose, in the median: soft edges and blur make an object look larger or smaller than it is drawn."""
        assert self._colours is not None
        width, height = self.predictor.size
        size = (width // scale, height // scale)
        [seen], [drawn] = crops(view, self._drawn, self._outline, [pose], size, self.renderer, rgb=False)
        lines = outline_lines(seen, drawn, self._colours, self._colours.seen(seen), self.model.center)
        if lines is None:
            return 0.0
        there = Pose.rotation(seen.R_view_cam) @ pose @ self.model.T_obj_ctr
        off = ((lines.places - drawn.camera.project(there.apply(lines.points))) * lines.normals).sum(axis=1)
        return float(np.clip(np.median(off), -MOST_GROWN, MOST_GROWN))

    def _follow(self, view: View, last: GaussianPose) -> Estimate | None:
        """From where the object is expected; None where it cannot be compared."""
        started = time.perf_counter()
        before, colours = self._before, self._colours
        assert before is not None and colours is not None
        predicted = self._outlined(view, self._predicted(view, before, last, colours), last, colours)
        return self._measured(view, predicted, last.pose, started)

    def _measured(self, view: View, predicted: GaussianPose, last: Pose, started: float) -> Estimate | None:
        """From an expected ``T_cam_ctr``; None where it cannot be compared. last: ``T_cam_ctr`` in the frame before.
        started: in seconds of time.perf_counter."""
        network, angle, comparisons = 0.0, 0.0, 0
        colours, tint, state = self._colours, self._tint, predicted
        assert colours is not None and tint is not None
        while comparisons < self.config.iterations:
            comparisons += 1
            pose = state.pose @ self.model.T_ctr_obj
            if not self._in_front(pose):
                return None
            seen, drawn = self._crops(view, pose)
            T_view_ctr = Pose.rotation(seen.R_view_cam) @ state.pose
            assert drawn.mask is not None
            apart, known = self._off_colour(seen, drawn, T_view_ctr)
            apart = np.where(known[..., None], apart, tint.apart)
            other = tint.hides(apart, drawn.mask)
            visible = colours.seen(seen) & ~other & seen.shown
            answer = self._executor.submit(self._compared, seen, drawn, visible)
            # while the network computes
            keyframe = Keyframe(seen, drawn, T_view_ctr, visible)
            more = self._lines(keyframe, seen, visible, colours) + self._texture(keyframe)
            new_colours = colours.mixed(learn(seen, drawn.mask, visible), self.config.learn)
            new_tint = tint.mixed(Tint.of(apart, visible & drawn.mask), TINT_RATE)
            keyframe.prepare()
            prediction, seconds = answer.result()
            network, angle = network + seconds, prediction.angle
            combined = self._combined(predicted, keyframe, prediction, more)
            if combined is None:
                return None
            turn = math.degrees(rotation_angle(combined.pose.R @ state.pose.R.T))
            there = Pose.rotation(seen.R_view_cam) @ combined.pose
            self._bias += BIAS_RATE * (self._disagreement(keyframe, prediction, there) - self._bias)
            state = combined
            if turn < self.config.again_deg:
                break
        pose = state.pose @ self.model.T_ctr_obj
        if not self._in_front(pose):
            return None
        assert drawn.mask is not None
        shown = drawn.mask & seen.shown
        share = float((visible & shown).sum() / max(1, shown.sum()))
        self._motion = Pose(state.pose.R @ last.R.T, state.pose.t - last.t)
        self._state, self._before = state, keyframe
        if self._appearance is not None:
            self._appearance.compare(other, visible & drawn.mask & seen.shown)
        self._separated = contrast(seen, drawn.mask, colours)
        self._contradictions = self._contradicting(keyframe, prediction, more, there)
        if (
            angle < math.radians(self.config.restart_deg) or self._outline_holds()
        ) and share > self.config.min_colour_share:
            self._colours = new_colours
        self._tint = new_tint
        timings = {"network": network, "total": time.perf_counter() - started}
        return self._estimate(view, pose, angle, comparisons, share, timings)

    def _contradicting(
        self, keyframe: Keyframe, prediction: PairPrediction, more: Sequence[Residual], T_view_ctr: Pose
    ) -> int:
        """How many kinds of evidence contradict a pose: outline, colours, the network's angle and its correspondences.
        The network is believed as far as it has agreed before: on a mesh without colours it never does."""
        near = [
            np.abs(((keyframe.drawn.camera.project(T_view_ctr.apply(r.points)) - r.places) * r.normals).sum(axis=1))
            for r in more
            if isinstance(r, Lines)
        ]
        borne_out = sum(int((each < NEAR_PX).sum()) for each in near) / max(1, len(keyframe.outline[0]))
        distance, (usual_angle, usual_distance) = self._distance(keyframe, prediction, T_view_ctr), self._usual
        kinds = (
            self.config.outline and borne_out < BORNE_OUT,
            self._separated < LESS_CONTRAST * self._separated_first,
            prediction.angle > max(math.radians(WIDE_DEG), TWICE * usual_angle),
            distance > max(WIDE_PX, TWICE * usual_distance),
        )
        count = sum(kinds)
        if count < CONTRADICTED:
            self._separated_usual += USUAL_RATE * (self._separated - self._separated_usual)
            self._usual = (
                usual_angle + USUAL_RATE * (prediction.angle - usual_angle),
                usual_distance + USUAL_RATE * (distance - usual_distance),
            )
        return count

    def _distance(self, keyframe: Keyframe, prediction: PairPrediction, T_view_ctr: Pose) -> float:
        """The median distance, pixels, of the network's correspondences from where a pose puts them; 0 without any."""
        found, drawn = prediction.correspondences, keyframe.drawn
        if found is None or not len(found.source):
            return 0.0
        assert drawn.coords is not None
        points = drawn.coords[found.source[:, 1], found.source[:, 0]] - self.model.center
        there = drawn.camera.project(T_view_ctr.apply(points.astype(np.float64)))
        return float(np.median(np.linalg.norm(there - found.target, axis=1)))

    def _predicted(self, view: View, before: Keyframe, last: GaussianPose, colours: Colours) -> GaussianPose:
        """Where the object is expected, as ``T_cam_ctr``: from the last frame, without a comparison with the mesh."""
        camera, R = before.drawn.camera, before.seen.R_view_cam
        in_view = last.turned(R)
        start = self._expected(in_view.pose, R)
        known: list[Residual] = [_about(start, camera, PREDICTED)]
        motion: list[Residual] = [_about(start, camera, UNPREDICTED)]
        seen = before.again(view)
        following = self._executor.submit(self._followed, before, start, seen)
        lines = self._lines(before, seen, before.visible, colours)
        points = following.result()
        known += points
        motion += points
        found = fuse(start, [*known, *lines], camera)
        pose = start if found is None else found.pose
        moved = np.sum([residual.equations(pose, camera)[0] for residual in motion], axis=0)
        covariance = in_view.covariance / self.config.keep + np.linalg.inv(moved)
        return GaussianPose(pose, np.asarray(np.linalg.inv(covariance))).turned(R.T)

    def _outlined(self, view: View, predicted: GaussianPose, last: GaussianPose, colours: Colours) -> GaussianPose:
        """``predicted`` (``T_cam_ctr``) moved to where the frame's colours show the outline, from coarse to fine. The
        last motion once more is another start, since quick motion leaves followed points behind. Of these poses and
        the predicted one that is taken whose silhouette separates the colours best."""
        if not self.config.scales or not self.config.outline:
            return predicted
        starts = [predicted.pose]
        if not _moved_little(self._motion, predicted.pose, self._before):
            starts.append(Pose(self._motion.R @ last.pose.R, last.pose.t + self._motion.t))
        *coarse, fine = self.config.scales
        aligned = [self._aligned(view, replace(predicted, pose=start), colours, coarse) for start in starts]
        candidates = [predicted, *aligned]
        qualities = [self._separation(view, each.pose, colours) for each in candidates]
        if max(qualities) < LESS_SEPARATED * self._separated_usual:
            best = candidates[int(np.argmax(qualities))].pose
            for axis in np.concatenate([np.eye(3), -np.eye(3)]):
                start = replace(predicted, pose=Pose(so3_exp(TURNED * axis) @ best.R, best.t))
                candidates.append(self._aligned(view, start, colours, coarse))
                qualities.append(self._separation(view, candidates[-1].pose, colours))
        margins = [0.0, *[self.config.margin] * len(aligned), *[TURNED_MARGIN] * (len(candidates) - 1 - len(aligned))]
        best_of = int(np.argmax(np.array(qualities) - margins))
        return self._aligned(view, candidates[best_of], colours, [fine])

    def _separation(self, view: View, T_cam_ctr: Pose, colours: Colours) -> float:
        """How well the silhouette of a pose separates the colours, see `contrast`."""
        pose = T_cam_ctr @ self.model.T_ctr_obj
        if not self._in_front(pose):
            return -1.0
        width, height = self.predictor.size
        size = (width // 2, height // 2)
        [seen], [drawn] = crops(view, self._coarse, self._outline, [pose], size, self.renderer, rgb=False, coords=False)
        assert drawn.mask is not None
        return contrast(seen, drawn.mask, colours)

    def _aligned(self, view: View, start: GaussianPose, colours: Colours, scales: Sequence[int]) -> GaussianPose:
        """A ``T_cam_ctr`` fitted to the outline in ever finer crops of a frame, held near its start by its
        information."""
        state = start
        width, height = self.predictor.size
        for scale in scales:
            pose = state.pose @ self.model.T_ctr_obj
            if not self._in_front(pose):
                return start
            size, mesh = (width // scale, height // scale), self._drawn if scale == 1 else self._coarse
            [seen], [drawn] = crops(view, mesh, self._outline, [pose], size, self.renderer, rgb=False)
            lines = outline_lines(seen, drawn, colours, colours.seen(seen), self.model.center)
            if lines is None:
                continue
            lines = replace(lines, places=lines.places - self._grown[scale] * lines.normals)
            R = seen.R_view_cam
            fitted = fuse(Pose.rotation(R) @ state.pose, [start.turned(R), lines], drawn.camera, steps=3)
            if fitted is not None:
                state = replace(start, pose=Pose.rotation(R.T) @ fitted.pose)
        return state

    def _expected(self, last: Pose, R_view_cam: NDArray[np.float64]) -> Pose:
        """``T_view_ctr`` after the last motion, where that is to be repeated."""
        if self.config.motion != "velocity":
            return last
        share = self.config.prior
        turn = so3_exp(R_view_cam @ so3_log(self._motion.R) * share)
        return Pose(turn @ last.R, last.t + share * (R_view_cam @ self._motion.t))

    def _combined(
        self, predicted: GaussianPose, keyframe: Keyframe, prediction: PairPrediction, more: list[Residual]
    ) -> GaussianPose | None:
        """The pose by the network, by what else compares the mesh, and by the frames before."""
        camera, R = keyframe.drawn.camera, keyframe.seen.R_view_cam
        network: list[Residual] = []
        if self.config.still_deg <= math.degrees(prediction.angle) < self.config.restart_deg:
            network = self._network(keyframe, prediction)
        found = fuse(keyframe.T_view_ctr, [predicted.turned(R), *network, *more], camera)
        if found is None:
            return None
        return found.spread(_about(found.pose, camera, LEAST_STD).covariance).turned(R.T)

    def _followed(self, before: Keyframe, start: Pose, seen: View) -> list[Residual]:
        found = follow_points(before, start, seen, self.model) if self.config.motion == "points" else None
        return [] if found is None else [found]

    def _to_be_learned(self, seen: View, drawn: View, visible: NDArray[np.bool_]) -> bool:
        """Whether a first frame does not have the mesh's colours."""
        return self.config.appearance and not (self.model.coloured and colours_agree(seen, drawn, visible))

    def _off_colour(self, seen: View, drawn: View, T_view_ctr: Pose) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """`off_colour` of a crop, and where (H, W) the object's colours are known: everywhere by the mesh; where the
        mesh's colours are wrong, where the video has shown them."""
        if self._appearance is None:
            return off_colour(seen, drawn), np.ones(seen.image.shape[:2], np.bool_)
        image, known = self._appearance.painted(drawn, T_view_ctr)
        return off_colour(seen, replace(drawn, image=image)), known

    def _texture(self, keyframe: Keyframe) -> list[Residual]:
        found = match_texture(keyframe, self.model) if self.config.texture and self.model.coloured else None
        return [] if found is None else [found]

    def _lines(self, keyframe: Keyframe, seen: View, visible: NDArray[np.bool_], colours: Colours) -> list[Residual]:
        """Where the mesh's outline, as it was drawn for ``keyframe``, lies in a crop of the same camera."""
        if not self.config.outline:
            return []
        lines = outline_lines(seen, keyframe.drawn, colours, visible, self.model.center, keyframe.outline)
        return [] if lines is None else [replace(lines, places=lines.places - self._grown[1] * lines.normals)]

    def _crops(self, view: View, pose: Pose, *, coords: bool = True) -> tuple[View, View]:
        """What the frame shows round a ``T_cam_obj``, and the mesh drawn there."""
        size = self.predictor.size
        [seen], [drawn] = crops(view, self._drawn, self._outline, [pose], size, self.renderer, coords=coords)
        return seen, drawn

    def _compared(self, seen: View, drawn: View, visible: NDArray[np.bool_]) -> tuple[PairPrediction, float]:
        """The network's output, and the seconds that it took."""
        assert drawn.mask is not None
        mask = {"colours": drawn.mask & visible, "pose": drawn.mask, "none": None}[self.config.mask]
        started = time.perf_counter()
        [prediction] = self.predictor.predict([seen.with_mask(mask)], [drawn])
        return prediction, time.perf_counter() - started

    def _network(self, keyframe: Keyframe, prediction: PairPrediction) -> list[Residual]:
        """The network's correspondences, or where it has none, the pose it leads to."""
        found, camera = prediction.correspondences, keyframe.drawn.camera
        if found is None:
            target = apply_delta(keyframe.T_view_ctr, prediction.delta, camera.fx)
            spread = max(prediction.angle, math.radians(GIVEN[0]))
            return [GaussianPose.about(target, camera, spread, 1.0, 0.02)] if target.t[2] > 0 else []
        assert keyframe.drawn.coords is not None
        points = keyframe.drawn.coords[found.source[:, 1], found.source[:, 0]] - self.model.center
        if not len(points):
            return []
        doubt = (1 + (prediction.angle / ANGLE_OF_DOUBLE) ** 2) * (1 + (self._bias / BIASED) ** 2)
        scale = np.maximum(found.scale_px, LEAST_SCALE)
        weight = np.where(_shown_at(keyframe.seen, found.target), found.weight, 0.0)
        return [Points(points.astype(np.float64), found.target, weight, scale, KNEE, CORRELATED * doubt)]

    def _disagreement(self, keyframe: Keyframe, prediction: PairPrediction, T_view_ctr: Pose) -> float:
        """How far, in pixels of the crop, the object's points lie in the pose that the network alone gives from where
        they lie in the ``T_view_ctr`` that all evidence gave; the mean over the convex hull's corners."""
        camera, bias, self._bias = keyframe.drawn.camera, self._bias, 0.0
        network = self._network(keyframe, prediction)
        self._bias = bias
        alone = fuse(T_view_ctr, [_about(T_view_ctr, camera, (30.0, 20.0, 0.2)), *network], camera)
        if alone is None:
            return bias
        there, here = (camera.project(_before_camera(pose.apply(self._outline))) for pose in (alone.pose, T_view_ctr))
        return min(MOST_BIASED, float(np.linalg.norm(there - here, axis=1).mean()))

    def _estimate(
        self, view: View, pose: Pose, angle: float, iterations: int, score: float, timings: dict[str, float]
    ) -> Estimate:
        box = view.camera.points_box(_before_camera(pose.apply(self.model.hull_vertices)))
        converged = angle < math.radians(self.config.converged_deg)
        return Estimate(pose, angle, iterations, converged, score, box, self.model.name, timings=timings)

    def _in_front(self, pose: Pose) -> bool:
        return bool(np.isfinite(pose.matrix).all() and pose.apply(self.model.center)[2] > NEAR * self.model.diameter)

    def _on_branch(self, found: Estimate, branch: Branch = Branch.LAST) -> Estimate:
        """Of equivalent poses the one nearest to the last one that was returned, where there is one."""
        if self._last_pose is not None:
            found = nearest_to(self._last_pose, found, self.model, branch)
        elif self.model.symmetries:
            found = replace(found, branch=Branch.ANY)
        self._last_pose = found.T_cam_obj
        return found

    # --- losing and finding ---

    def _judged(self, view: View, found: Estimate) -> str:
        """The state of a frame that was followed: uncertain where the evidence is missing or contradicts, lost where it
        has been so for too long, and at once where the object is outside the picture."""
        x0, y0, x1, y1 = found.box
        width, height = view.camera.size
        inside = max(0.0, min(x1, width) - max(x0, 0.0)) * max(0.0, min(y1, height) - max(y0, 0.0))
        share = inside / max((x1 - x0) * (y1 - y0), 1e-9)
        in_doubt = (
            share < self.config.least_inside
            or found.score < self.config.min_colour_share
            or (math.degrees(found.angle) > self.config.restart_deg and not self._outline_holds())
        )
        self._doubts = self._doubts + 1 if in_doubt else 0
        contradicted = self._contradictions >= CONTRADICTED
        self._contradicted = self._contradicted + 1 if contradicted else 0
        if share == 0 or self._doubts >= self.config.doubts:
            return LOST
        return UNCERTAIN if in_doubt or contradicted else TRACKED

    def _outline_holds(self) -> bool:
        """Whether the last frame's silhouette separates the colours at least half as well as the first one's did.

        Then the predicted angle alone is no reason for doubt: on a mesh without colours, or a shining one, it says
        little."""
        return self._separated_first > CLEAR and self._separated > 0.5 * self._separated_first

    def _reset(self) -> None:
        self._state = self._before = self._colours = None
        self._motion, self._doubts, self._waiting = Pose.identity(), 0, 0
        self._contradictions = self._contradicted = 0

    def _remember(self, view: View, found: Estimate) -> None:
        """What is known of the object in a frame that is tracked."""
        state, before = self._know()
        sure = found.score > SURE and (math.degrees(found.angle) < self.config.restart_deg or self._outline_holds())
        T_view_ctr = Pose.rotation(before.seen.R_view_cam) @ state.pose
        if self.config.remember and sure and self._memory.wants(T_view_ctr):
            self._memory.keep(view, before, T_view_ctr)
        if sure and self._appearance is not None and self._appearance.wants(T_view_ctr):
            pose, camera = T_view_ctr @ self.model.T_ctr_obj, before.seen.camera
            [drawn] = self.renderer.render(self._drawn, [pose], camera, rgb=False, coords=True)
            self._appearance.keep(before.seen, drawn, T_view_ctr, before.visible)

    def _better(self, view: View) -> Estimate | None:
        """What memory finds when a pose has been contradicted for some frames; where it finds nothing that is borne
        out, the pose is followed further."""
        late = self._contradicted - self.config.doubts
        if self.config.search_beside or late < 0 or late % self.config.search:
            return None
        kept = {name: getattr(self, name) for name in FOLLOWED}
        found = self._recalled(view)
        if found is None:
            for name, value in kept.items():
                setattr(self, name, value)
        return found

    def _know(self) -> tuple[GaussianPose, Keyframe]:
        """Keep what the last frame tells."""
        state, before, colours, tint = self._state, self._before, self._colours, self._tint
        assert state is not None and before is not None and colours is not None and tint is not None
        self._known = _Known(state.pose, colours, tint, self._separated_first)
        return state, before

    def _find(self, view: View) -> Tracked:
        """A new first pose, where there is one. A search takes time, so not every frame is searched."""
        self._waiting -= 1
        if self._waiting > 0:
            return Tracked(LOST)
        self._waiting = self.config.search
        found = self._searched(view)
        if found.state != LOST:
            self._waiting = 0
        return found

    def _find_beside(self, view: View) -> Tracked:
        """The same without waiting for the search, which has a frame of its own."""
        if self._searching is None:
            if time.monotonic() >= self._search_next:
                self._searcher = self._searcher or ThreadPoolExecutor(1, "posekit-search")
                self._search_began = time.monotonic()
                self._searching = self._searcher.submit(self._searched, view)
            return Tracked(LOST)
        if not self._searching.done():
            return Tracked(LOST)
        answer, self._searching = self._searching, None
        now = time.monotonic()
        self._search_next = now + (now - self._search_began) * (1 / self.config.search_share - 1)
        found = answer.result()
        if found.estimate is None or now - self._search_began > self.config.search_age:
            self._reset()
            return Tracked(LOST)
        return self._brought_on(view, found.estimate)

    def _brought_on(self, view: View, found: Estimate) -> Tracked:
        """A pose that was found in an earlier frame, in the newest one."""
        self._know()
        there = self._regained(view, [found.T_cam_obj])
        there = there or self._regained(view, self._by_colours(view))
        if there is None:
            self._reset()
            return Tracked(LOST)
        return Tracked(TRACKED, self._on_branch(there), restarted=True)

    def _searched(self, view: View) -> Tracked:
        """By memory, else by the detector. It is tracked from then on where it is found."""
        with _ONE_SEARCH:
            found = self._recalled(view) or self._at_colours(view) or self._detected(view)
        return Tracked(LOST) if found is None else Tracked(TRACKED, self._on_branch(found), restarted=True)

    def _recalled(self, view: View) -> Estimate | None:
        """Where views that were kept, and colours that were learned, lead to."""
        self._place = None
        if not self.config.remember or self._known is None:
            return None
        last = self._known.T_cam_ctr @ self.model.T_ctr_obj
        found = self._regained(view, self._memory.by_features(view))
        return found or self._regained(view, [last, *self._by_colours(view)])

    def _at_colours(self, view: View) -> Estimate | None:
        """What a search of the mesh's views finds where the frame has the object's colours: it may have turned."""
        if self._place is None:
            return None
        box = view.camera.points_box(_before_camera(self._place.apply(self.model.hull_vertices)))
        place, self._place = Detection(box, None, 1.0, self.model.name, Source.BOX), None
        poses = [each.T_cam_obj for each in self.estimator.estimate(view, [place], SURE)]
        return self._regained(view, poses)

    def _by_colours(self, view: View) -> list[Pose]:
        assert self._known is not None
        found = self._memory.by_colours(view, self._known.colours, self._known.T_cam_ctr, CANDIDATES)
        return distinct(found, self.model)

    def _regained(self, view: View, candidates: Sequence[Pose]) -> Estimate | None:
        """The first of the ``T_cam_obj``, fitted to the frame, that the evidence bears out; it is followed from then
        on. Those are compared whose silhouette separates the known colours best."""
        known = self._known
        assert known is not None
        fitted = []
        for pose in candidates:
            if not self._in_front(pose):
                continue
            centred = pose @ self.model.T_obj_ctr
            camera = self._crop_camera(view, pose)
            start = self._aligned(view, _about(centred, camera, REGAINED), known.colours, self.config.scales)
            fitted.append((self._separation(view, start.pose, known.colours), start))
        fitted.sort(key=lambda each: -each[0])
        self._place = None
        if fitted and fitted[0][0] > max(CLEAR, PLACE_CONTRAST * known.separated):
            self._place = fitted[0][1].pose @ self.model.T_ctr_obj
        for quality, start in fitted[:COMPARED]:
            if quality < max(CLEAR, LEAST_CONTRAST * known.separated):
                break
            self._colours, self._tint, self._separated_first = known.colours, known.tint, known.separated
            self._doubts, started, borne_out = 0, time.perf_counter(), False
            for _ in range(STEPS):
                found = self._measured(view, start, start.pose, started)
                if found is None or borne_out:
                    break
                borne_out = self._judged(view, found) == TRACKED and found.score > SURE
                assert self._state is not None
                start = _about(self._state.pose, self._crop_camera(view, found.T_cam_obj), PREDICTED)
            if found is not None and borne_out and self._judged(view, found) == TRACKED:
                self._motion = Pose.identity()
                return found
            self._reset()
        return None

    def _crop_camera(self, view: View, pose: Pose) -> Camera:
        return zoom_to_pose(view.camera, pose @ self.model.T_obj_ctr, self._outline, self.predictor.size).camera

    def _detected(self, view: View) -> Estimate | None:
        """What the detector and a search of the mesh find."""
        if self.detector is None:
            return None
        detections = self.detector.detect(view, [self.model])
        # a person's word for the first frame is taken; later detections may be wrong, whatever the detector
        options = SearchOptions.usual(detections) if self._last_pose is None else SearchOptions()
        [found] = find_instances(lambda _: self.estimator, view, [self.model], detections, options)
        if not found.instances or not self._begin(view, found.instances[0].T_cam_obj, found.instances[0].angle):
            return None
        _, before = self._know()
        if self.config.remember and not self._memory.views:
            self._memory.keep(view, before, before.T_view_ctr)
        return found.instances[0]


@dataclass(frozen=True, eq=False)
class _Known:
    """Of the last frame that was tracked. separated: contrast of a silhouette in its place."""

    T_cam_ctr: Pose
    colours: Colours
    tint: Tint
    separated: float


def _about(pose: Pose, camera: Camera, spread: tuple[float, float, float]) -> GaussianPose:
    turn, shift, depth = spread
    return GaussianPose.about(pose, camera, math.radians(turn), shift, depth)


def _moved_little(motion: Pose, pose: Pose, before: Keyframe | None) -> bool:
    """Whether the last motion is below four pixels of the crop: then the outline is found without repeating it."""
    camera = None if before is None else before.drawn.camera
    return camera is None or float(np.linalg.norm(motion.t)) * camera.fx / max(float(pose.t[2]), 1e-6) < 4.0


def _predictor(estimator: PoseEstimator, config: TrackConfig) -> Predictor:
    if config.runtime == "torch" or estimator.runtime.runtime == "torch":
        return estimator.predictor
    return estimator.runtime.predictor_for(1, math.ceil(0.75 * usable_cores()))  # the tracker itself works beside it


def _shown_at(view: View, pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether a crop shows something at pixels (N, 2)."""
    if view.valid is None:
        return np.ones(len(pixels), np.bool_)
    columns, rows = np.clip(np.rint(pixels).astype(int), 0, np.array(view.camera.size) - 1).T
    return np.asarray(view.valid[rows, columns])


def _before_camera(points: NDArray[np.float64]) -> NDArray[np.float64]:
    points[:, 2] = np.maximum(points[:, 2], 1e-3)
    return points
