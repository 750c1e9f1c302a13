"""Networks: shapes, statistics, losses and their gradients, weights on disk, one batch over-fitted.

Weights. Accepted: NAME.safetensors with NAME.toml beside it, named by the file, its stem or its folder; in 16 or 32
bits; without MV-Net. Refused: a file that is missing or damaged, one without its TOML, another preset, a TOML of other
weights (by the hash), unknown keys, tensors that are missing, too many or of another shape, numbers that are not
finite. There are no warnings: weights are read strictly.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from posekit.camera import Camera
from posekit.errors import ConfigError, WeightsError
from posekit.nets.config import LiteConfig, PaperConfig, find_weights
from posekit.nets.flownet import LAYERS, FlowNetEncoder
from posekit.nets.heads import PoseHeads, Prediction, compress_angle, expand_angle
from posekit.nets.inputs import images_to_tensor, relief, to_input
from posekit.nets.lite import LiteSVNet, attention, normals_of, similarity_of, soft_flow, warp, with_none
from posekit.nets.losses import Target, dense_loss, matching_loss, mvnet_loss, svnet_loss, true_score
from posekit.nets.paper import Branch, PaperMVNet, PaperSVNet
from posekit.nets.precision import choose_device
from posekit.nets.pytorch import NetworkPredictor
from posekit.nets.rigid import Motion, Surface, exp_so3, induced_flow, solve_motion
from posekit.nets.weights import build, load_networks, save_networks
from posekit.view import View

SMALL = LiteConfig(size=(64, 48), widths=(16, 32), blocks=2, bottleneck=16, fine=16)
TINY_PAPER = PaperConfig(size=(128, 96), width=0.125)


def pictures(count: int, size: tuple[int, int], seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 4, size[1], size[0], generator=generator) - 0.5


def lite_pair(count: int, size: tuple[int, int] = SMALL.size) -> tuple[torch.Tensor, ...]:
    """What LiteSVNet takes: observed, rendered, relief, focal."""
    observed, rendered = pictures(count, size), pictures(count, size, 1)
    rendered[:, 3] = 0
    rendered[:, 3, 8:-8, 8:-8] = 1
    bumps = 0.2 * torch.rand(count, size[1], size[0], generator=torch.Generator().manual_seed(2))
    return observed[:, :3], rendered, bumps, torch.full((count,), 6.0)


def test_the_paper_preset_has_the_papers_layers() -> None:
    branch = Branch((640, 480), 1.0)
    svnet, mvnet = PaperSVNet(branch), PaperMVNet(branch)
    assert svnet.branch is mvnet.branch, "the branch is shared"
    convolutions = sum(p.numel() for p in branch.encoder.parameters())
    assert 24.0e6 < convolutions < 24.4e6  # FlowNetS's ten layers on 8 channels (24.1 M)
    assert branch.fc.in_features == 8 * 10 * 1024 and branch.fc.out_features == 256
    assert (mvnet.fc.in_features, mvnet.fc.out_features) == (6 * 256, 512)
    assert (svnet.fc.in_features, svnet.fc.out_features) == (256, 256)
    assert mvnet.heads.angle is None and svnet.heads.angle is not None
    with torch.inference_mode():
        out = svnet(pictures(1, (640, 480)), pictures(1, (640, 480), 1))
    assert out.quat_wxyz.shape == (1, 4) and out.v.shape == (1, 3) and out.angle is not None


def test_the_paper_networks_at_reduced_size() -> None:
    networks = build("paper", TINY_PAPER)
    assert isinstance(networks.svnet, PaperSVNet) and networks.mvnet is not None
    observed, views = pictures(2, TINY_PAPER.size), pictures(12, TINY_PAPER.size).view(2, 6, 4, 96, 128)
    out = networks.mvnet(observed, views)
    assert out.quat_wxyz.shape == (2, 4) and out.v.shape == (2, 3) and out.angle is None
    first = networks.svnet(observed, views[:, 0])
    assert first.angle is not None and first.angle.shape == (2,)
    torch.testing.assert_close(first.quat_wxyz, torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4), atol=0.2, rtol=0)
    assert torch.count_nonzero(first.v) == 0, "DeepIM starts the translation at zero"


def flownets_state(channels: int = 6) -> dict[str, torch.Tensor]:
    state, last = {}, channels
    for k, (name, kernel, _, out) in enumerate(LAYERS):
        state[f"{name}.0.weight"] = torch.full((out, last, kernel, kernel), 0.01 * (k + 1))
        state[f"{name}.0.bias"] = torch.full((out,), 0.5)
        last = out
    return state


def test_a_flownets_checkpoint_loads_with_zero_mask_channels() -> None:
    encoder = FlowNetEncoder()
    encoder.load_flownets(flownets_state())
    first = encoder.get_submodule("conv1")
    assert isinstance(first, torch.nn.Conv2d)
    assert torch.all(first.weight[:, :6] == 0.01) and torch.all(first.weight[:, 6:] == 0)
    last = encoder.get_submodule("conv6_1")
    assert isinstance(last, torch.nn.Conv2d) and torch.all(last.weight == 0.1)


def test_a_foreign_checkpoint_is_refused() -> None:
    state = flownets_state()
    del state["conv3.0.weight"]
    with pytest.raises(WeightsError, match=r"conv3\.weight"):
        FlowNetEncoder().load_flownets(state)
    with pytest.raises(WeightsError, match="full-width"):
        FlowNetEncoder(0.5).load_flownets(flownets_state())
    state = flownets_state()
    del state["conv1.0.bias"]
    with pytest.raises(WeightsError, match="FlowNetS_BN"):
        FlowNetEncoder().load_flownets(state)


def test_lite_answers_on_its_anchors() -> None:
    net = LiteSVNet(SMALL).eval()
    output = net.predict(*lite_pair(3))
    prediction = output.prediction
    assert prediction.flow is not None and prediction.flow.shape == (3, 2, 12, 16)
    assert prediction.log_scale is not None and prediction.log_scale.shape == (3, 12, 16)
    assert prediction.visibility is not None and prediction.visibility.shape == (3, 12, 16)
    assert [f.shape for f in output.flows] == [(3, 2, 6, 8)] * 2
    assert [f.shape for f in output.rigid] == [(3, 2, 12, 16)] * 2
    assert output.compressed_angle.shape == (3,)
    assert [x.shape for x in output.similarities] == [(3, 48, 49)] * 2
    assert prediction.certainty is not None and prediction.certainty.shape == (3, 12, 16)
    assert prediction.silhouettes is not None and prediction.silhouettes.shape == (3, 2, 12, 16)
    assert prediction.score is not None and prediction.score.shape == (3,)


def test_the_lite_preset_is_small_and_answers_in_one_batch_as_alone() -> None:
    net = LiteSVNet().eval()
    assert sum(p.numel() for p in net.parameters()) < 8e6
    pair = lite_pair(2, LiteConfig().size)
    with torch.inference_mode():
        both, alone = net(*pair), net(*(x[1:] for x in pair))
    torch.testing.assert_close(both.flow[1:], alone.flow, atol=1e-3, rtol=1e-3)


def test_weights_without_mvnet_load_without_it(tmp_path: Path) -> None:
    networks = build("lite", SMALL)
    save_networks(tmp_path / "lite", dataclasses.replace(networks, mvnet=None), {})
    assert load_networks("lite", tmp_path).mvnet is None


def test_matching_finds_a_shifted_picture() -> None:
    generator = torch.Generator().manual_seed(0)
    rendered = torch.randn(1, 64, 12, 16, generator=generator)
    observed = torch.roll(rendered, shifts=(1, 2), dims=(2, 3))  # down 1, right 2
    none = torch.full((1, 192, 1), -10.0)
    flow, found = soft_flow(with_none(50 * similarity_of(rendered, observed), none), (12, 16))
    inner = flow[0, :, :11, :14]  # what was not rolled over the side
    torch.testing.assert_close(inner, torch.tensor([16.0, 8.0]).view(2, 1, 1).expand_as(inner), atol=0.05, rtol=0)
    assert float(found[:, 0].min()) > 0.9 and float(found[:, 1].max()) < 1e-3
    _, found = soft_flow(with_none(50 * similarity_of(rendered, observed), none + 100), (12, 16))
    assert float(found[:, 1].min()) > 0.99, "no cell is shown"


def test_warping_by_the_flow_undoes_the_shift() -> None:
    x = torch.randn(1, 16, 12, 16, generator=torch.Generator().manual_seed(0))
    moved = torch.roll(x, shifts=(1, 2), dims=(2, 3))
    flow = torch.tensor([2.0, 1.0]).view(1, 2, 1, 1).expand(1, 2, 12, 16)
    torch.testing.assert_close(warp(moved, flow)[..., :11, :14], x[..., :11, :14], atol=1e-4, rtol=0)


def test_attention_is_torchs() -> None:
    q, k, v = torch.randn(3, 2, 2, 10, 8, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(attention(q, k, v), torch.nn.functional.scaled_dot_product_attention(q, k, v))


def bumpy_surface(count: int) -> Surface:
    generator = torch.Generator().manual_seed(4)
    return Surface.of(0.3 * torch.rand(count, 12, 16, generator=generator), torch.full((count,), 5.0), 4, 2.0)


def test_the_motion_behind_a_flow_is_found() -> None:
    surface = bumpy_surface(3)
    turn = torch.tensor([[0.3, 0.0, 0.0], [0.0, -0.4, 0.1], [0.1, 0.1, 0.5]])
    true = Motion(exp_so3(turn), torch.tensor([[0.01, 0.0, 0.05], [0.0, 0.02, -0.04], [0.0, 0.0, 0.0]]))
    found = solve_motion(surface, induced_flow(surface, true), torch.ones(3, 192), steps=6)
    torch.testing.assert_close(found.R, true.R, atol=1e-3, rtol=0)
    torch.testing.assert_close(found.t, true.t, atol=1e-3, rtol=0)


def test_anchors_without_weight_do_not_move_the_motion() -> None:
    surface, weight = bumpy_surface(1), torch.ones(1, 192)
    flow = torch.zeros(1, 192, 2)
    flow[:, ::3], weight[:, ::3] = 50.0, 0.0
    found = solve_motion(surface, flow, weight)
    torch.testing.assert_close(found.R[0], torch.eye(3), atol=1e-4, rtol=0)
    none = solve_motion(surface, flow, torch.zeros(1, 192))
    torch.testing.assert_close(none.R[0], torch.eye(3), atol=1e-4, rtol=0)


def test_the_solver_teaches_its_weights() -> None:
    """The gradient of the pose's error must lower the weight of the one wrong anchor."""
    surface, flow = bumpy_surface(1), torch.zeros(1, 192, 2)
    flow[:, 17] = 30.0
    weight = torch.ones(1, 192, requires_grad=True)
    induced_flow(surface, solve_motion(surface, flow, weight)).square().sum().backward()
    assert weight.grad is not None and int(weight.grad[0].argmax()) == 17 and float(weight.grad[0, 17]) > 0


def test_relief_is_depth_about_its_mean_in_widths() -> None:
    camera = Camera(80.0, 80.0, 7.5, 5.5, 16, 12)
    depth = np.zeros((12, 16), np.float32)
    depth[2, 2], depth[2, 6] = 1.0, 1.2
    found = relief(View(np.zeros((12, 16, 3), np.uint8), camera, depth > 0, depth))
    assert found.shape == (12, 16)
    np.testing.assert_allclose(found[2, [2, 6]], [-0.1 / 1.1 * 5, 0.1 / 1.1 * 5], rtol=1e-5)
    assert np.count_nonzero(found) == 2


def test_normals_are_those_of_a_plane_and_ignore_its_edges() -> None:
    """depth = 1 + 0.1 (u - 31.5) / f: a slope of a tenth; relief is depth / mean - 1 in widths of the crop."""
    focal, (h, w) = 4.0, (48, 64)
    depth = (1 + 0.1 * (torch.arange(w) - 31.5) / (focal * w)).expand(1, h, w)
    mask = torch.zeros(1, h, w)
    mask[:, 10:30, 20:50] = 1
    found = normals_of((depth - 1) * focal * mask, mask)
    expected = torch.tensor([0.1, 0.0, -1.0]) / (1 + 0.1**2) ** 0.5
    inside = found[0, :, 10:30, 20:50]
    torch.testing.assert_close(inside, expected.view(3, 1, 1).expand_as(inside), atol=1e-4, rtol=0)
    assert not found[:, :, :10].any() and not found[:, :, :, 50:].any()


def test_inputs_agree() -> None:
    rng = np.random.default_rng(0)
    image, mask = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8), rng.random((6, 8)) > 0.5
    tensor = images_to_tensor(torch.from_numpy(np.dstack([image, mask * np.uint8(255)]))[None])
    np.testing.assert_allclose(tensor[0].numpy(), to_input(image, mask), atol=1e-6)
    assert not to_input(image, None)[3].any()


def test_the_angle_scale_is_its_own_inverse() -> None:
    angle = torch.linspace(0, torch.pi, 50)
    torch.testing.assert_close(expand_angle(compress_angle(angle)), angle)


def test_a_negative_angle_can_be_mended() -> None:
    value = torch.full((3,), -2.0, requires_grad=True)
    (torch.full((3,), 0.5) - expand_angle(value)).abs().sum().backward()
    assert value.grad is not None and (value.grad < 0).all()


def test_statistics_make_the_answers_the_targets_mean() -> None:
    heads = PoseHeads(8, with_angle=True)
    quat = torch.nn.functional.normalize(torch.tensor([[1.0, 0.1, 0, 0], [1.0, -0.1, 0.2, 0]]), dim=1)
    v = torch.tensor([[1.0, 2.0, 0.1], [3.0, 2.0, -0.1]])
    heads.set_statistics(quat, v)
    _, translation, angle = heads(torch.zeros(1, 8))
    torch.testing.assert_close(translation[0], torch.tensor([2.0, 2.0, 0.0]))
    assert angle is not None and angle.shape == (1,)


def test_the_papers_losses_against_numbers_by_hand() -> None:
    heads = PoseHeads(8, with_angle=True)
    heads.v_std.copy_(torch.tensor([2.0, 2.0, 0.1]))
    quat, v, angle = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.tensor([0.3])
    guess = Prediction(torch.tensor([[0.0, 2.0, 0, 0]]), torch.tensor([[6.0, 8.0, 0.0]]), torch.tensor([0.1]))
    # |1 - 0| + ||(3, 4, 0)|| + |1 - 2| (+ |0.3 - 0.1|)
    assert float(svnet_loss(guess, heads, quat, v, angle)) == pytest.approx(1 + 5 + 1 + 0.2)
    assert float(mvnet_loss(guess, heads, quat, v)) == pytest.approx((1 + 5 + 1) / 6)


def random_target(count: int, config: LiteConfig) -> Target:
    h, w = config.size[1] // 4, config.size[0] // 4
    generator = torch.Generator().manual_seed(3)
    quat = torch.nn.functional.normalize(
        torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(count, 4, generator=generator), dim=1
    )
    shift = 4 * torch.randn(count, 2, 1, 1, generator=generator)
    lost = torch.zeros(count, dtype=torch.bool)
    valid = torch.zeros(count, h, w, dtype=torch.bool)
    valid[:, 3:-3, 3:-3] = True
    return Target(shift.expand(count, 2, h, w).contiguous(), valid, valid.clone(), quat,
                  torch.randn(count, 3, generator=generator), torch.rand(count, generator=generator), lost,
                  torch.stack([valid, valid], dim=1).float())  # fmt: skip


def test_the_matching_loss_is_least_where_the_truth_is() -> None:
    flow = torch.full((1, 2, 6, 8), 8.0)  # one cell right, one down
    shown = torch.ones(1, 6, 8, dtype=torch.bool)
    right = torch.zeros(1, 48, 49)
    right[0, :, -1] = 25.0  # what lies beside the crop is none
    for y in range(5):
        for x in range(7):
            right[0, y * 8 + x, (y + 1) * 8 + x + 1] = 50.0
    assert float(matching_loss(right, flow, shown, shown)) < 0.1
    assert float(matching_loss(right, torch.zeros_like(flow), shown, shown)) > 10
    assert float(matching_loss(torch.zeros(1, 48, 49), flow, shown, shown)) == pytest.approx(np.log(49), rel=1e-4)
    hidden = torch.zeros_like(shown)
    assert float(matching_loss(right, flow, hidden, shown)) > 10, "hidden cells are none"
    assert float(matching_loss(right, flow, hidden, hidden)) == 0


def test_lost_pairs_do_not_teach_the_pose() -> None:
    net = LiteSVNet(SMALL)
    target = random_target(2, SMALL)
    target.lost[:] = True
    loss, parts = dense_loss(net.predict(*lite_pair(2)), net.heads, target)
    assert parts["rotation"] == parts["translation"] == parts["likelihood"] == 0
    loss.backward()
    assert net.heads.rotation.weight.grad is None or not net.heads.rotation.weight.grad.any()
    assert net.heads.angle is not None and net.heads.angle.weight.grad is not None
    assert net.heads.angle.weight.grad.any()


def test_one_batch_is_over_fitted() -> None:
    torch.manual_seed(0)
    net = LiteSVNet(SMALL)
    target = random_target(4, SMALL)
    net.heads.set_statistics(target.quat_wxyz, target.v)
    pair = lite_pair(4)
    optimiser = torch.optim.AdamW(net.parameters(), lr=3e-3)
    found: list[dict[str, torch.Tensor]] = []
    for _ in range(150):
        loss, parts = dense_loss(net.predict(*pair), net.heads, target)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        found.append(parts)
    assert found[-1]["epe_px"] < 0.25 * found[0]["epe_px"]
    assert found[-1]["rotation"] < 0.3 * found[0]["rotation"]
    assert found[-1]["angle"] < 0.3 * found[0]["angle"]
    assert found[-1]["silhouettes"] < 0.3 * found[0]["silhouettes"]


def test_the_true_score_falls_with_the_distance() -> None:
    target = random_target(3, SMALL)
    target.flow[:] = torch.tensor([0.0, 2.0, 200.0]).view(3, 1, 1, 1)
    found = true_score(target, 2.0 * 2**0.5)
    torch.testing.assert_close(found, torch.tensor([1.0, 0.36788, 0.0]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("preset", "config"), [("lite", SMALL), ("paper", TINY_PAPER)])
def test_weights_come_back_as_they_went(tmp_path: Path, preset: str, config: LiteConfig | PaperConfig) -> None:
    networks = build(preset, config)
    digest = save_networks(tmp_path / "mine", networks, {"trained_on": "nothing", "steps": 0})
    for given in (tmp_path / "mine", tmp_path / "mine.safetensors", tmp_path / "mine.toml"):
        loaded = load_networks(preset, given)
        assert loaded.digest == digest and loaded.config == config and loaded.about["trained_on"] == "nothing"
    for name, value in networks.svnet.state_dict().items():
        half = value.half().float() if value.is_floating_point() else value
        torch.testing.assert_close(loaded.svnet.state_dict()[name], half)
    assert (loaded.mvnet is None) == (networks.mvnet is None)
    assert {p.name for p in tmp_path.iterdir()} == {"mine.safetensors", "mine.toml"}
    assert all(v.dtype != torch.float32 for v in load_file(tmp_path / "mine.safetensors").values())


def test_loading_does_not_import_the_compiler(tmp_path: Path) -> None:
    """In an interpreter of its own, some 2 s: torch's compiler takes another second to import."""
    save_networks(tmp_path / "paper", build("paper", TINY_PAPER), {})
    code = (
        "import sys; from pathlib import Path; from posekit.nets.weights import load_networks;"
        f"load_networks('lite'); load_networks('paper', Path({str(tmp_path / 'paper')!r}));"
        "assert 'torch._dynamo' not in sys.modules, 'torch._dynamo was imported'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_bad_weights_are_refused(tmp_path: Path) -> None:
    save_networks(tmp_path / "lite", build("lite", SMALL), {})
    with pytest.raises(WeightsError, match="no weights at"):
        load_networks("lite", tmp_path / "other")
    with pytest.raises(WeightsError, match="preset 'lite', not 'paper'"):
        load_networks("paper", tmp_path / "lite")
    data = (tmp_path / "lite.safetensors").read_bytes()
    (tmp_path / "lite.safetensors").write_bytes(data[: len(data) // 2])
    with pytest.raises(WeightsError, match="damaged"):
        load_networks("lite", tmp_path / "lite")
    (tmp_path / "lite.safetensors").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(WeightsError, match=r"not the one of lite\.toml"):
        load_networks("lite", tmp_path / "lite")
    (tmp_path / "lite.toml").unlink()
    with pytest.raises(WeightsError, match=r"needs lite\.toml"):
        load_networks("lite", tmp_path / "lite")
    with pytest.raises(WeightsError, match="unknown preset"):
        build("huge")
    with pytest.raises(WeightsError, match="ships no trained weights"):
        find_weights("paper")


@pytest.mark.parametrize(
    "config",
    [
        "size = [1000000000, 96]",
        'size = "large"',
        "widths = [64]",
        "blocks = 3",
        "widths = [0, 0]",
        "blocks = 2147483647",
        "heads = 2147483647",
        "heads = 5",
        "fine = 1.5",
        "size = [100, 96]",
    ],
)
def test_a_configuration_that_does_not_fit_its_weights_is_refused(tmp_path: Path, config: str) -> None:
    """Before anything is made of the size that it asks for."""
    save_networks(tmp_path / "lite", build("lite", SMALL), {})
    head = (tmp_path / "lite.toml").read_text()
    start, end = head.index("[config]"), head.index("[about]")
    (tmp_path / "lite.toml").write_text(f"{head[:start]}[config]\n{config}\n\n{head[end:]}")
    with pytest.raises(WeightsError, match="makes no networks"):
        load_networks("lite", tmp_path)


def test_the_device_is_one_that_is_there() -> None:
    there = torch.cuda.is_available()
    assert choose_device("cpu") == "cpu" and choose_device("auto") == ("cuda" if there else "cpu")
    with pytest.raises(ConfigError, match="auto, cpu, cuda"):
        choose_device("tpu")
    if not there:
        with pytest.raises(ConfigError, match="finds no GPU"):
            choose_device("cuda")


def test_networks_compute_where_they_were_moved() -> None:
    """The meta device computes shapes alone: what is not sent there, or not taken back, fails."""
    networks = build("lite", SMALL)
    predictor = NetworkPredictor(networks, bfloat16=False)
    assert predictor.device.type == "cpu"
    seen: list[str] = []
    networks.svnet.register_forward_pre_hook(lambda _, inputs: seen.extend(x.device.type for x in inputs))
    assert networks.moved("meta").device.type == "meta"
    moved = NetworkPredictor(networks, bfloat16=False)
    view = View(np.zeros((48, 64, 3), np.uint8), Camera(60.0, 60.0, 31.5, 23.5, 64, 48))
    drawn = dataclasses.replace(view, mask=np.ones((48, 64), bool), depth=np.ones((48, 64), np.float32))
    with pytest.raises(RuntimeError):  # it computes no numbers
        moved.predict([view], [drawn])
    assert seen == ["meta"] * 4
