"""The predicted angle, calibrated: SV-Net's angle head, fitted to the errors that refinement leaves.

In a training the head sees poses disturbed at random. The loop asks it about poses that the network itself has moved,
where what is left is what the network cannot see: there the head predicted far too small errors. So once the rest is
trained, the head alone (one linear layer) is fitted again, on the poses that the loop passes through.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from posekit.errors import TrainingError
from posekit.estimate.refine import compare, update_pose
from posekit.geometry import Pose, random_rotation, rotation_angle
from posekit.nets.heads import compress_angle
from posekit.nets.pytorch import NetworkPredictor
from posekit.nets.weights import Networks
from posekit.render import Renderer
from posekit.train.measure import Case

SEED = 2_000_003  # of the cases, apart from the held-back ones that a training is measured on
FAR = 6  # one case of so many starts from anywhere
LEAST = 30  # poses; with fewer there is nothing to fit
ROUNDS, BATCH, RATE, DECAY = 600, 256, 2e-3, 0.3

Tell = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Passed:
    """Poses that the loop passed through. features: float32 (N, C), what the heads were given; angle: (N,), the true
    rotation error, radians, the least over the object's symmetries; last: bool (N,), where a loop ended."""

    features: NDArray[np.float32]
    angle: NDArray[np.float32]
    last: NDArray[np.bool_]


def passed_poses(
    networks: Networks, cases: Sequence[Case], renderer: Renderer, iterations: int = 5, tell: Tell | None = None
) -> Passed:
    """Refine every case, and keep what the network was shown. tell: called with the numbers of done and of all."""
    predictor = NetworkPredictor(networks)
    update = "correspondence" if networks.dense else "regression"
    features: list[NDArray[np.float32]] = []
    angles: list[float] = []
    last: list[bool] = []

    def keep(_: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        features.append(inputs[0].detach().float().cpu().numpy()[0])

    hook = networks.svnet.heads.register_forward_pre_hook(keep)
    try:
        for k, case in enumerate(cases):
            if tell is not None:
                tell(k, len(cases))
            pose, hull = _start(case, k), case.model.hull_ctr
            for n in range(iterations):
                [found], [seen], [drawn] = compare(case.view, case.model, hull, [pose], predictor, renderer)
                angles.append(_error(pose, case))
                updated = update_pose(pose, case.model, found, seen, drawn, update, colour_edge=True)
                last.append(updated is None or n == iterations - 1)
                if updated is None:
                    break
                pose = updated
    finally:
        hook.remove()
    return Passed(np.array(features), np.array(angles, np.float32), np.array(last))


def calibrate(networks: Networks, cases: Sequence[Case], renderer: Renderer, tell: Tell | None = None) -> Networks:
    """The networks with an angle head whose median is right on the poses of the loop. Raises TrainingError where there
    are too few cases or the network's outputs are not finite."""
    passed = passed_poses(networks, cases, renderer, tell=tell)
    if len(passed.angle) < LEAST or not np.isfinite(passed.features).all():
        raise TrainingError(
            f"the angle cannot be calibrated on {len(passed.angle)} poses: it takes {LEAST}, and finite features."
        )
    svnet = copy.deepcopy(networks.svnet)
    head = svnet.heads.angle
    assert head is not None
    weight, bias = fit_median(torch.from_numpy(passed.features), compress_angle(torch.from_numpy(passed.angle)))
    with torch.no_grad():
        head.weight.copy_(weight[None])
        head.bias.copy_(bias)
    return replace(networks, svnet=svnet)


def fit_median(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """weight (C,) and bias () of the linear function of x (N, C) with the least mean |y - f(x)|, y (N,)."""
    middle, spread = x.mean(0), x.std(0).clamp_min(1e-3)
    z = (x - middle) / spread
    weight = torch.zeros(x.shape[1], requires_grad=True)
    bias = y.median().clone().requires_grad_()
    optimiser = torch.optim.AdamW([{"params": [weight], "weight_decay": DECAY}, {"params": [bias], "weight_decay": 0}],
                                  lr=RATE)  # fmt: skip
    draw = torch.Generator().manual_seed(SEED)
    for step in range(ROUNDS):
        for group in optimiser.param_groups:
            group["lr"] = RATE * (1 - step / ROUNDS)
        chosen = torch.randint(len(z), (BATCH,), generator=draw)
        loss = (y[chosen] - z[chosen] @ weight - bias).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    found = weight.detach() / spread
    return found, bias.detach() - found @ middle


def _start(case: Case, k: int) -> Pose:
    if k % FAR:
        return case.start
    T_cam_ctr = case.start @ case.model.T_obj_ctr
    turned = Pose(random_rotation(np.random.default_rng([SEED, k])), T_cam_ctr.t)
    return turned @ case.model.T_ctr_obj


def _error(pose: Pose, case: Case) -> float:
    return min(float(rotation_angle(pose.R.T @ (case.truth @ S).R)) for S in case.model.symmetries.transforms())
