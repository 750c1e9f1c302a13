"""The lite recipe: SV-Net on rendered pairs, MV-Net beside it on boxed crops, one tower for both. Layer 5."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import IterableDataset

from posekit.data.stream import Batch, PairStream
from posekit.nets.heads import PoseHeads
from posekit.nets.inputs import images_to_tensor
from posekit.nets.lite import LiteMVNet, LiteSVNet
from posekit.nets.losses import DenseLossConfig, Target, dense_loss, first_pose_loss
from posekit.nets.weights import Networks, save_networks
from posekit.render import Renderer
from posekit.train.config import TrainConfig
from posekit.train.measure import Case, bop_cases, held_back_cases, measure
from posekit.train.sources import Sources

MEASURED = 20  # batches that the statistics are measured on


class LiteModule(nn.Module):
    """A batch in, the loss out; all networks in one forward, as several processes need it."""

    def __init__(self, nets: nn.ModuleDict, config: DenseLossConfig) -> None:
        super().__init__()
        self.nets, self.config = nets, config

    def forward(self, batch: Batch, seed: int) -> tuple[Tensor, dict[str, float]]:  # noqa: ARG002 - nothing is drawn
        svnet = self.nets["svnet"]
        assert isinstance(svnet, LiteSVNet)
        output = svnet.predict(images_to_tensor(batch["observed"]), images_to_tensor(batch["rendered"]))
        first = self._first_pose(batch) if "mvnet" in self.nets else None
        with torch.autocast(batch["flow"].device.type, enabled=False):
            loss, parts = dense_loss(output, svnet.heads, target_of(batch), self.config)
            if first is not None:
                heads = self.nets["mvnet"].heads
                assert isinstance(heads, PoseHeads)
                added, more = first_pose_loss(first, heads, batch["mv_quat_wxyz"], batch["mv_v"])
                loss, parts = loss + self.config.mvnet * added, parts | more
        return loss, parts

    def _first_pose(self, batch: Batch) -> Any:
        mvnet = self.nets["mvnet"]
        assert isinstance(mvnet, LiteMVNet)
        observed, views = batch["mv_observed"], batch["mv_views"]
        pictures = images_to_tensor(torch.cat([observed, views.flatten(0, 1)]))
        features = mvnet.encode(pictures)
        kept = features[len(observed) :].unflatten(0, views.shape[:2])
        return mvnet.match(features[: len(observed)], kept[batch["mv_object"]])


def target_of(batch: Batch) -> Target:
    """The truth of a batch's pairs."""
    return Target(batch["flow"], batch["valid"], batch["visible"], batch["quat_wxyz"], batch["v"], batch["angle"],
                  batch["lost"])  # fmt: skip


class LiteTask:
    """The recipe for the loop. fresh: the networks that have no measured statistics yet. MV-Net is trained where
    the stream has samples for it."""

    def __init__(self, config: TrainConfig, networks: Networks, sources: Sources, fresh: frozenset[str]) -> None:
        self.config, self.networks, self.sources, self.fresh = config, networks, sources, fresh
        nets: dict[str, nn.Module] = {"svnet": networks.svnet}
        if config.stream.mvnet and networks.mvnet is not None:
            nets["mvnet"] = networks.mvnet
        self.nets = nn.ModuleDict(nets)
        self.module: nn.Module = LiteModule(self.nets, config.loss)
        self.module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def stream(self, start: int, rank: int) -> IterableDataset[Batch]:
        return PairStream(self.config.stream, self.config.seed, self.sources.photos, self.sources.models, start=start,
                          rank=rank)  # fmt: skip

    def prepare(self, batches: Callable[[int], Iterator[Batch]]) -> None:
        """The paper's zero mean and unit variance, where the networks are new."""
        fresh = self.fresh & set(self.nets)
        if not fresh:
            return
        stream = batches(0)
        found = [next(stream) for _ in range(MEASURED)]
        if "svnet" in fresh:
            quat, v = (torch.cat([b[key][~b["lost"]] for b in found]) for key in ("quat_wxyz", "v"))
            _heads(self.nets["svnet"]).set_statistics(quat, v)
        if "mvnet" in fresh:
            quat, v = (torch.cat([b[key] for b in found]) for key in ("mv_quat_wxyz", "mv_v"))
            _heads(self.nets["mvnet"]).set_statistics(quat, v)

    def validate(self, nets: nn.Module) -> dict[str, float]:
        return measure_task(self._with(copy.deepcopy(nets).cpu()), self.cases, self.bop, self.renderer)

    def export(self, nets: nn.Module, out: Path, about: Mapping[str, Any]) -> None:
        save_networks(out / "lite", self._with(nets), {**about, "trained_on": self.sources.about})

    def _with(self, nets: nn.Module) -> Networks:
        """The networks that ``nets`` holds."""
        assert isinstance(nets, nn.ModuleDict)
        mvnet = dict(nets).get("mvnet")
        return dataclasses.replace(self.networks, svnet=nets["svnet"], mvnet=mvnet)  # type: ignore[arg-type]

    @cached_property
    def renderer(self) -> Renderer:
        return Renderer()

    @cached_property
    def cases(self) -> list[Case]:
        return held_back_cases(self.renderer, self.sources.models, self.sources.photos, self.config.stream.scenes,
                               self.config.stream.augment, self.config.cases)  # fmt: skip

    @cached_property
    def bop(self) -> list[Case]:
        held = self.sources.validation
        return bop_cases(held, self.config.cases) if held is not None else []


def measure_task(networks: Networks, cases: list[Case], bop: list[Case], renderer: Renderer) -> dict[str, float]:
    """Measures of the held-back renderings and, as ``bop_*``, of a data set; the score is the data set's where there
    is one."""
    found = measure(cases, networks, renderer) if cases else {}
    if bop:
        found |= {f"bop_{k}": v for k, v in measure(bop, networks, renderer).items()}
    return {"score": found.get("bop_add", found.get("add", 0.0)), **found}


def _heads(module: nn.Module) -> PoseHeads:
    heads = module.heads
    assert isinstance(heads, PoseHeads)
    return heads
