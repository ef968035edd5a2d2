import copy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from tensordict import TensorDict

from coachable.distributions.hl_gauss import HLGauss, initialise_value
from coachable.networks import make_critic
from coachable.networks.hl_gauss_critic import make_hl_gauss_critic

F64 = torch.float64
PAPER = HLGauss()  # 255 bins on (-600, 1000), ratio 0.75


def reference_encoding(y: float, bins: HLGauss) -> np.ndarray:
    """Truncated, renormalised Gaussian from the normal distribution's own cdf, bin by bin."""
    w = (bins.v_max - bins.v_min) / bins.num_atoms
    edges = [bins.v_min + i * w for i in range(bins.num_atoms + 1)]
    y = min(max(y, bins.v_min), bins.v_max)
    # The survival function keeps the digits of the upper tail that the cdf loses.
    lower, upper = np.array(edges[:-1]), np.array(edges[1:])
    mass = np.where(
        lower > y,
        norm.sf(lower, y, bins.sigma) - norm.sf(upper, y, bins.sigma),
        norm.cdf(upper, y, bins.sigma) - norm.cdf(lower, y, bins.sigma),
    )
    return mass / mass.sum()


def test_geometry_of_the_paper() -> None:
    assert PAPER.bin_width == pytest.approx(6.27451, abs=1e-5)
    assert PAPER.sigma == pytest.approx(80 / 17, rel=1e-12)
    centres, edges = PAPER.centres(torch.zeros(1, dtype=F64)), PAPER.edges(torch.zeros(1, dtype=F64))
    assert edges.shape == (256,) and edges[0] == -600 and edges[-1] == pytest.approx(1000, abs=1e-10)
    assert centres[0] == pytest.approx(-596.8627, abs=1e-4) and centres[-1] == pytest.approx(996.8627, abs=1e-4)


@pytest.mark.parametrize("bins", [PAPER, HLGauss(-3, 1, 21, 0.4), HLGauss(0, 1, 2)], ids=repr)
def test_encoding_against_the_normal_distribution(bins: HLGauss) -> None:
    span = bins.v_max - bins.v_min
    values = [bins.v_min + span * x for x in (-2.0, -1e-9, 0.0, 1e-3, 0.1, 0.37, 0.5, 0.8, 0.999, 1.0, 1.5)]
    p = bins.encode(torch.tensor(values, dtype=F64))
    expected = np.array([reference_encoding(y, bins) for y in values])
    np.testing.assert_allclose(p.numpy(), expected, atol=1e-10)
    np.testing.assert_allclose(p.sum(-1).numpy(), 1.0, atol=1e-12)
    # Float32 knows 600 to 3e-5, which is 6e-6 standard deviations.
    np.testing.assert_allclose(bins.encode(torch.tensor(values)).numpy(), expected, atol=5e-6)


def test_target_on_a_centre_and_on_an_edge() -> None:
    centre = PAPER.centres(torch.zeros(1, dtype=F64))[100]
    p = PAPER.encode(centre)
    assert p[100].item() == pytest.approx(0.4950149, abs=1e-7) and p.argmax() == 100
    edge = PAPER.edges(torch.zeros(1, dtype=F64))[100]
    p = PAPER.encode(edge)
    assert p[99].item() == pytest.approx(p[100].item(), rel=1e-9)


def test_outside_values_are_clipped() -> None:
    """Unclipped, float32 gives 0/0 from about 1026."""
    far = PAPER.encode(torch.tensor([5000.0, 1e30, -1e30, -601.0]))
    border = PAPER.encode(torch.tensor([1000.0, 1000.0, -600.0, -600.0]))
    assert torch.equal(far, border)
    assert PAPER.clipped_fraction(torch.tensor([5000.0, 0.0, -600.0, -601.0])).item() == 0.5


def test_decode_inverts_encode() -> None:
    """Inside, the error is below (w/pi) exp(-2 pi^2 0.75^2); at the ends the mean is 4.3303 inwards."""
    values = torch.linspace(-560, 960, 4001, dtype=F64)
    decoded = PAPER.mean(PAPER.encode(values))
    bound = PAPER.bin_width / np.pi * np.exp(-2 * np.pi**2 * 0.75**2)
    assert bound < 3.1e-5 and (decoded - values).abs().max() <= bound
    ends = PAPER.mean(PAPER.encode(torch.tensor([-600.0, 1000.0], dtype=F64)))
    np.testing.assert_allclose(ends.numpy(), [-600 + 4.3303, 1000 - 4.3303], atol=1e-4)


def test_decode_is_monotone_and_exact_on_atoms() -> None:
    decoded = PAPER.mean(PAPER.encode(torch.linspace(-700, 1100, 5001, dtype=F64)))
    assert (decoded.diff() >= 0).all()
    logits = torch.full((255,), -1e9, dtype=F64)
    logits[7] = 0
    torch.testing.assert_close(PAPER.decode(logits), PAPER.centres(logits)[7])
    logits = torch.randn(4, 5, 255, dtype=F64)
    shifted = np.exp(logits.numpy())
    expected = (shifted / shifted.sum(-1, keepdims=True) * PAPER.centres(logits).numpy()).sum(-1)
    np.testing.assert_allclose(PAPER.decode(logits).numpy(), expected, rtol=1e-10)
    np.testing.assert_allclose(PAPER.decode(logits.float()).numpy(), expected, rtol=1e-4, atol=1e-3)


def test_cross_entropy_and_its_gradient() -> None:
    torch.manual_seed(0)
    logits = torch.randn(2, 6, 255, dtype=F64, requires_grad=True)
    target = torch.tensor([0.0, -650.0, 12.3, 999.0, 2000.0, 400.0], dtype=F64)
    losses = PAPER.cross_entropy(logits, target)
    assert losses.shape == (2, 6)
    p = np.array([reference_encoding(y, PAPER) for y in target.tolist()])
    x = logits.detach().numpy()
    log_softmax = x - np.log(np.exp(x).sum(-1, keepdims=True))
    np.testing.assert_allclose(losses.detach().numpy(), -(p * log_softmax).sum(-1), rtol=1e-10)
    losses.sum().backward()
    np.testing.assert_allclose(logits.grad.numpy(), np.exp(log_softmax) - p, atol=1e-10)  # type: ignore[union-attr]


def test_float32_under_autocast() -> None:
    logits, target = torch.randn(3, 255), torch.tensor([1.0, 500.0, -20.0])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value, loss = PAPER.decode(logits), PAPER.cross_entropy(logits, target)
    assert torch.equal(value, PAPER.decode(logits)) and torch.equal(loss, PAPER.cross_entropy(logits, target))
    assert PAPER.decode(logits.bfloat16()).dtype == torch.float32
    assert PAPER.encode(target.bfloat16()).dtype == torch.float32


@settings(max_examples=100, deadline=None)
@given(
    st.floats(allow_nan=False, allow_infinity=True, width=32),
    st.lists(st.floats(-1e30, 1e30), min_size=9, max_size=9),
    st.sampled_from([HLGauss(-1, 1, 9), HLGauss(-600, 1000, 9, 0.05), HLGauss(0, 1e-3, 9, 5.0)]),
)
def test_no_nan(target: float, logits: list[float], bins: HLGauss) -> None:
    x = torch.tensor(logits, dtype=torch.float32, requires_grad=True)
    p = bins.encode(torch.tensor(target))
    assert p.isfinite().all() and abs(p.sum().item() - 1) < 1e-5 and p.min() >= 0
    (bins.cross_entropy(x, torch.tensor(target)) + bins.decode(x)).backward()
    assert x.grad is not None and x.grad.isfinite().all()


def test_fresh_critic_predicts_the_initial_value() -> None:
    torch.manual_seed(0)
    td = TensorDict({"observation": torch.randn(50, 6), "action": torch.randn(50, 2)}, [50])
    plain = PAPER.decode(make_hl_gauss_critic(6, 2, None, (32, 32), initial_value=None)(td)["state_action_value"])
    assert 50 < plain.mean() < 350  # the middle of the support, give or take the initial logits
    for initial_value in (0.0, 300.0):
        critic = make_hl_gauss_critic(6, 2, None, (32, 32), initial_value=initial_value)
        value = PAPER.decode(critic(td)["state_action_value"])
        assert (value - initial_value).abs().max() < 8
    head = [m for m in critic.modules() if isinstance(m, torch.nn.Linear)][-1]
    distance = (np.linspace(-600 + 3.13725490, 1000 - 3.13725490, 255) - 300) / 40
    np.testing.assert_allclose(head.bias.detach().numpy(), np.maximum(-0.5 * distance**2, -8), atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"v_min": 1.0, "v_max": 1.0}, "v_min must be less than v_max"),
        ({"v_min": 2.0, "v_max": 1.0}, "v_min must be less than v_max"),
        ({"v_max": float("inf")}, "v_min must be less than v_max and both finite"),
        ({"num_atoms": 0}, "num_atoms must be an integer of at least 2, got 0"),
        ({"num_atoms": 2.5}, "num_atoms must be an integer"),
        ({"sigma_ratio": 0.0}, "sigma_ratio must be positive"),
    ],
)
def test_bad_support(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HLGauss(**arguments)


def test_bad_initial_value() -> None:
    with pytest.raises(ValueError, match="initial_value must lie in"):
        make_hl_gauss_critic(6, 2, None, (8,), initial_value=2000.0)
    with pytest.raises(ValueError, match="must have 255 outputs"):
        initialise_value(make_critic(6, 2, None, (8,), num_outputs=32), PAPER, 0.0)


def test_copies() -> None:
    PAPER.centres(torch.zeros(1))
    assert repr(copy.deepcopy(PAPER)) == repr(PAPER)


def test_constants_first_used_in_inference_mode_still_differentiate():
    gauss = HLGauss(-1.0, 1.0, 8)
    with torch.inference_mode():
        gauss.centres(torch.zeros(1))
    logits = torch.zeros(3, 8, requires_grad=True)
    (logits.softmax(-1) * gauss.centres(logits)).sum().backward()
    assert logits.grad is not None and logits.grad.isfinite().all()
