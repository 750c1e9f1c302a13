"""What the recipes share: measuring and exporting."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import nn

from posekit.errors import ConfigError
from posekit.mesh.model import ObjectModel
from posekit.nets.heads import PoseHeads
from posekit.nets.weights import Networks, save_networks
from posekit.render import Renderer
from posekit.train.config import TrainConfig
from posekit.train.measure import Case, CaseSource, bop_cases, measure, rendered_cases
from posekit.train.sources import Sources


class PoseTask:
    """SV-Net and, where it is trained, MV-Net.

    fresh: the networks that have no measured statistics yet. models: the meshes of the held-back renderings.
    """

    def __init__(self, config: TrainConfig, networks: Networks, sources: Sources, fresh: frozenset[str],
                 models: list[ObjectModel], with_mvnet: bool) -> None:  # fmt: skip
        self.config, self.networks, self.sources, self.models = config, networks, sources, models
        nets: dict[str, nn.Module] = {"svnet": networks.svnet}
        if with_mvnet:
            assert networks.mvnet is not None
            nets["mvnet"] = networks.mvnet
        self.nets = nn.ModuleDict(nets)
        self.fresh = fresh & set(nets)

    def heads(self, name: str) -> PoseHeads:
        """The pose heads of network ``name``, "svnet" or "mvnet"."""
        heads = self.nets[name].heads
        assert isinstance(heads, PoseHeads)
        return heads

    def validate(self, nets: nn.Module) -> dict[str, float]:
        """Measures of the held-back renderings and, as ``bop_*``, of the data set to validate on; the score is the
        data set's where there is one."""
        networks = self._with(copy.deepcopy(nets).cpu())
        found = measure(self.cases, networks, self.renderer) if self.cases else {}
        if self.bop:
            found |= {f"bop_{k}": v for k, v in measure(self.bop, networks, self.renderer).items()}
        return {"score": found.get("bop_add", found.get("add", 0.0)), **found}

    def export(self, nets: nn.Module, out: Path, about: Mapping[str, Any]) -> None:
        """Write the networks with ``about``, what was seen and what they were trained on."""
        before = self.networks.about  # of the weights that the training started from, where it did
        own = self.sources.about(self.config.stream.share)
        trained_on = f"{before['trained_on']}; then {own}" if before.get("trained_on") else own
        seen = sorted({*before.get("seen", ()), *self.sources.seen})
        about = {**before, **about, "trained_on": trained_on, "seen": seen}
        save_networks(out / self.networks.preset, self._with(nets), about)

    def _with(self, nets: nn.Module) -> Networks:
        """The networks that ``nets`` holds."""
        assert isinstance(nets, nn.ModuleDict)
        return dataclasses.replace(self.networks, svnet=nets["svnet"], mvnet=dict(nets).get("mvnet"))  # type: ignore[arg-type]

    @cached_property
    def renderer(self) -> Renderer:
        """Made when it is first asked for."""
        return Renderer()

    @cached_property
    def cases(self) -> list[Case]:
        """Held-back renderings to measure on."""
        stream = self.config.stream
        source = CaseSource(self.models, self.sources.photos, stream.scenes, stream.augment)
        return rendered_cases(source, self.renderer, self.config.cases)

    @cached_property
    def bop(self) -> list[Case]:
        """Cases of the data set to validate on, none without one. Raises ConfigError where it shows none."""
        held = self.sources.validation
        if held is None or not self.config.cases:
            return []
        found = bop_cases(held, self.config.cases)
        if not found:
            raise ConfigError(
                f"--validate-on {held.root} shows nothing to measure on: no annotated object over 90 % visible with a "
                "mask in mask_visib/ and a box in scene_gt_info.json."
            )
        return found
