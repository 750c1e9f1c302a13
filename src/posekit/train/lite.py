"""The lite recipe: SV-Net on rendered pairs, MV-Net beside it on boxed crops, one tower for both."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.utils.data import IterableDataset

from posekit.nets.inputs import images_to_tensor
from posekit.nets.lite import LiteSVNet
from posekit.nets.losses import DenseLossConfig, Target, dense_loss
from posekit.nets.mvnet import rgb_input, view_input
from posekit.nets.mvnet_loss import mvnet_loss
from posekit.nets.weights import Networks
from posekit.train.config import TrainConfig
from posekit.train.data.stream import Batch, PairStream
from posekit.train.sources import Sources
from posekit.train.task import PoseTask

MEASURED = 640  # pairs that the statistics are measured on


class LiteModule(nn.Module):
    """A batch in, the loss out; all networks in one forward, as several processes need it."""

    def __init__(self, nets: nn.ModuleDict, config: DenseLossConfig) -> None:
        super().__init__()
        self.nets, self.config = nets, config

    def forward(self, batch: Batch, seed: int) -> tuple[Tensor, dict[str, Tensor]]:  # noqa: ARG002 - nothing is drawn
        """The loss of a batch and its parts; ``seed`` is not used."""
        svnet = self.nets["svnet"]
        assert isinstance(svnet, LiteSVNet)
        output = svnet.predict(
            images_to_tensor(batch["observed"]),
            images_to_tensor(batch["rendered"]),
            batch["relief"].float(),
            batch["focal"],
        )
        matched = None
        if "mvnet" in self.nets:
            observed, views = rgb_input(batch["mv_observed"]), view_input(batch["mv_views"])
            matched = self.nets["mvnet"](observed, views, batch["mv_object"], batch["mv_chosen"])
        with torch.autocast(batch["flow"].device.type, enabled=False):
            loss, parts = dense_loss(output, svnet.heads, target_of(batch), self.config)
            if matched is not None:
                added, more = mvnet_loss(matched, batch)
                loss, parts = loss + self.config.mvnet * added, parts | {f"mv_{k}": v for k, v in more.items()}
        return loss, parts


def target_of(batch: Batch) -> Target:
    """The truth of a batch's pairs."""
    return Target(batch["flow"], batch["valid"], batch["visible"], batch["quat_wxyz"], batch["v"], batch["angle"],
                  batch["lost"], batch["silhouettes"].float() / 255)  # fmt: skip


class LiteTask(PoseTask):
    """The recipe for the loop. MV-Net is trained where the stream has samples for it."""

    def __init__(self, config: TrainConfig, networks: Networks, sources: Sources, fresh: frozenset[str]) -> None:
        super().__init__(config, networks, sources, fresh, sources.models, with_mvnet=config.stream.mvnet > 0)
        self.module: nn.Module = LiteModule(self.nets, config.loss)
        self.module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def stream(self, start: int, rank: int) -> IterableDataset[Batch]:
        """Process ``rank``'s batches from number ``start`` on."""
        return PairStream(self.config.stream, self.config.seed, self.sources.photos, self.sources.models, start=start,
                          rank=rank)  # fmt: skip

    @property
    def measured(self) -> int:
        """Batches that `prepare` measures: none where the networks are not new."""
        return -(-MEASURED // self.config.stream.batch) if self.fresh else 0

    def prepare(self, batches: Sequence[Batch]) -> None:
        """The paper's zero mean and unit variance, where the networks are new."""
        if "svnet" in self.fresh:
            quat, v = (torch.cat([b[key][~b["lost"]] for b in batches]) for key in ("quat_wxyz", "v"))
            self.heads("svnet").set_statistics(quat, v)
