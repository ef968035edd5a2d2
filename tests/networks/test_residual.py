import pytest
import torch
import torch.nn.functional as F
from torch import nn

from coachable.networks.residual import ResidualBlock, ResidualMLP, fit_features, with_new_inputs

COMBAT = (4096, 2048, 1024, 512)


@pytest.mark.parametrize("side", ["end", "beginning"])
@pytest.mark.parametrize("width", [2, 5, 9])
def test_fit_features_equals_padding_by_a_possibly_negative_amount(side, width):
    x = torch.arange(1.0, 11.0).reshape(2, 5)
    pad = (0, width - 5) if side == "end" else (width - 5, 0)
    torch.testing.assert_close(fit_features(x, width, side), F.pad(x, pad), rtol=0, atol=0)


def test_block_is_relu_of_layer_norm_plus_skip():
    block = ResidualBlock(3, 4)
    x = torch.randn(7, 3)
    z = x @ block.linear.weight.T + block.linear.bias
    z = (z - z.mean(-1, keepdim=True)) / torch.sqrt(z.var(-1, unbiased=False, keepdim=True) + 1e-5)
    expected = z.clamp_min(0) + torch.cat((x, torch.zeros(7, 1)), -1)
    torch.testing.assert_close(block(x), expected)


def test_initialisation_is_glorot_uniform_with_zero_bias():
    block = ResidualBlock(300, 500)
    bound = (6 / 800) ** 0.5
    weight = block.linear.weight
    assert weight.abs().max() <= bound
    assert weight.abs().max() > 0.99 * bound
    assert abs(weight.std().item() / (bound / 3**0.5) - 1) < 0.01
    assert not block.linear.bias.any()


@pytest.mark.parametrize(("in_features", "paths"), [(100, 0), (1500, 0), (2048, 0), (2600, 40)])
def test_identity_paths_of_the_padded_network(in_features, paths):
    """How many inputs reach the last layer by skips alone; the counts follow from the widths by hand."""
    x = torch.arange(1.0, in_features + 1)
    out = x
    net_sides = ResidualMLP(4, 1, (4, 4, 4, 4)).blocks
    for block, width in zip(net_sides, COMBAT, strict=True):
        out = fit_features(out, width, block.side)
    assert int((out > 0).sum()) == paths


def test_zero_layer_norm_leaves_fit():
    net = ResidualMLP(6, 1, (16, 8, 8)).blocks
    for block in net:
        nn.init.zeros_(block.norm.weight)
    x = torch.randn(5, 6)
    # [x, 0] of 16, then the last 8 of those (padding side "beginning"): all zeros; nothing of x is left.
    torch.testing.assert_close(net(x), torch.zeros(5, 8), rtol=0, atol=0)
    equal = ResidualMLP(8, 1, (8, 8, 8)).blocks
    for block in equal:
        nn.init.zeros_(block.norm.weight)
    y = torch.randn(5, 8)
    torch.testing.assert_close(equal(y), y, rtol=0, atol=0)


def test_trunk_size_of_the_combat_network():
    with torch.device("meta"):
        net = ResidualMLP(1500, 1, COMBAT).blocks
    assert sum(p.numel() for p in net.parameters()) == 17_177_088


def test_head_is_float32_under_autocast():
    net = ResidualMLP(6, 3, (32, 32))
    x = torch.randn(4, 6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = net(x)
    assert out.dtype == torch.float32
    torch.testing.assert_close(out, net(x), rtol=0.05, atol=0.05)


@pytest.mark.parametrize(
    "options",
    [{"widths": ()}, {"widths": (4, 0)}, {"dropout": 1.0}],
)
def test_bad_options_raise(options):
    with pytest.raises(ValueError, match=r"must be|dropout is 1.0: expected a number in \[0, 1\)"):
        ResidualMLP(3, 1, **{"widths": (4, 4), **options})


@pytest.mark.parametrize("autocast", [False, True])
def test_float64_inputs_are_cast_to_the_parameters_dtype(autocast):
    network, observation, style = (
        ResidualMLP(7, 2, widths=(8, 8)),
        torch.randn(5, 4, dtype=torch.float64),
        torch.randn(5, 3),
    )
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        torch.testing.assert_close(network(observation, style), network(observation.float(), style), rtol=0, atol=0)
    assert network.double()(observation, style).dtype == torch.float64


def test_inputs_of_another_width_are_refused():
    with pytest.raises(ValueError, match=r"has 5 inputs, but got 4 \+ 2 = 6"):
        ResidualMLP(5, 1, (8,))(torch.zeros(3, 4), torch.zeros(3, 2))


def test_dropout_is_on_only_where_a_gradient_is_asked_for():
    torch.manual_seed(0)
    net = ResidualMLP(6, 1, (2000,), dropout=0.25).blocks
    plain = ResidualMLP(6, 1, (2000,)).blocks
    plain.load_state_dict(net.state_dict())
    x = torch.randn(6)
    own, whole = net(x) - fit_features(x, 2000), plain(x) - fit_features(x, 2000)  # of the input nothing is dropped
    torch.testing.assert_close(own, torch.where(own > 1e-6, whole / 0.75, 0.0))
    assert 0.2 < (own[whole > 1e-6] <= 1e-6).float().mean() < 0.3
    with torch.no_grad():
        torch.testing.assert_close(net(x), plain(x), rtol=0, atol=0)
    torch.testing.assert_close(net.eval()(x), plain(x), rtol=0, atol=0)


def test_head_gain_scales_the_initial_head():
    for gain in (1.0, 0.01):
        weight = ResidualMLP(6, 3, (64, 64), head_gain=gain).head.weight
        bound = gain * (6 / 67) ** 0.5
        assert 0.9 * bound < weight.abs().max() <= bound


@pytest.mark.parametrize("widths", [(4, 4), (13, 13), (16, 16, 16)], ids=["cut", "just wide enough", "padded"])
def test_new_inputs_change_nothing_while_they_are_zero(widths):
    """Behind them are two inputs that a padded identity path then carries elsewhere."""
    net, wide = ResidualMLP(8, 3, widths), ResidualMLP(13, 3, widths)
    for name, value in net.named_parameters():
        if "norm" in name or "bias" in name:
            nn.init.normal_(value)
    wide.load_state_dict(with_new_inputs(net.state_dict(), seen=6, new=5))
    x = torch.randn(7, 8)
    torch.testing.assert_close(wide(x[:, :6], torch.zeros(7, 5), x[:, 6:]), net(x))


def test_new_inputs_of_a_stack_of_networks():
    nets = [ResidualMLP(8, 3, (16, 16)) for _ in range(2)]
    stack = {name: torch.stack([net.state_dict()[name] for net in nets]) for name in nets[0].state_dict()}
    for name, value in with_new_inputs(stack, seen=6, new=5).items():
        for member, net in zip(value, nets, strict=True):
            assert torch.equal(member, with_new_inputs(net.state_dict(), seen=6, new=5)[name])


@pytest.mark.parametrize("widths", [(12, 12), (16, 20)], ids=["too narrow", "unequal"])
def test_no_room_for_new_inputs(widths):
    with pytest.raises(ValueError, match=r"cannot get 5 inputs after the first 6 of 8: expected equal layers"):
        with_new_inputs(ResidualMLP(8, 3, widths).state_dict(), seen=6, new=5)
