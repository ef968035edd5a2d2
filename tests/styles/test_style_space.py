"""StyleSpace: encoding, named styles, clamping, description and comparison."""

import copy
import json
import pickle
import warnings

import pytest
import torch

from coachable.styles import (
    Choice,
    ContinuousOneHot,
    Mixture,
    PointMass,
    Product,
    Setpoint,
    StyleRangeWarning,
    StyleSpace,
    Uniform,
    UniformChoice,
    Weight,
)


@pytest.fixture
def space() -> StyleSpace:
    """Every kind of parameter once; theta = (pose one-hot of 3, step_length, gap, fuel)."""
    return StyleSpace(
        [
            Choice("pose", ("front", "t_pose", "up"), default="t_pose"),
            Setpoint("step_length", 0.25, 0.75, unit="m", help="Length of a step", encoding="range"),
            Setpoint("gap", 0.0, 2.0, unit="m", default=0.5),
            Weight("fuel", -3.0, 105.0, evaluation=(0.0, 105.0)),
        ],
        name="test",
    )


def test_layout(space):
    assert space.names == ("pose", "step_length", "gap", "fuel")
    assert space.dim == 6
    assert space.slices == {"pose": slice(0, 3), "step_length": slice(3, 4), "gap": slice(4, 5), "fuel": slice(5, 6)}
    assert space.low.dtype == space.high.dtype == torch.float32
    assert space.low.tolist() == [0, 0, 0, 0.25, 0, -3]
    assert space.high.tolist() == [1, 1, 1, 0.75, 2, 105]
    assert space.default.tolist() == [0, 1, 0, 0.5, 0.5, 0]
    assert space["gap"].unit == "m" and "gap" in space and list(space) == list(space.names)
    assert space["fuel"].evaluation_range == (0.0, 105.0)
    assert space["gap"].evaluation_range == (0.0, 2.0)


def test_default_is_a_fresh_tensor(space):
    space.default.fill_(9)
    assert space.default.max() < 9


def test_encoding_closed_form(space):
    theta = torch.tensor([[0.0, 0.0, 1.0, 0.25, 2.0, -3.0], [1.0, 0.0, 0.0, 0.75, 0.5, 105.0]])
    expected = torch.tensor([[0.0, 0.0, 1.0, -1.0, 1.0, -3 / 105], [1.0, 0.0, 0.0, 1.0, 0.25, 1.0]])
    torch.testing.assert_close(space.encode(theta), expected, rtol=0, atol=1e-7)


def test_combat_encoding_lies_in_the_papers_range():
    """a = -0.05 b gives f in [-0.05, 1]; Skykiller's [-0.3, 0.3] gives [-1, 1]."""
    space = StyleSpace([Weight("melee", -0.375, 7.5), Weight("skykiller", -0.3, 0.3)])
    torch.testing.assert_close(space.encode(space.low), torch.tensor([-0.05, -1.0]))
    torch.testing.assert_close(space.encode(space.high), torch.tensor([1.0, 1.0]))


def test_encoding_keeps_batch_shape_and_gradient(space):
    theta = space.sample((2, 3)).requires_grad_()
    encoded = space.encode(theta)
    assert encoded.shape == (2, 3, 6)
    encoded.sum().backward()
    expected = torch.tensor([1.0, 1.0, 1.0, 4.0, 0.5, 1 / 105]).expand(2, 3, 6)
    torch.testing.assert_close(theta.grad, expected)


def test_encoding_first_used_in_inference_mode_still_differentiates(space):
    with torch.inference_mode():
        space.encode(space.default)
    space.encode(space.default.requires_grad_()).sum().backward()


def test_encoding_follows_theta_to_another_device(space):
    encoded = space.encode(torch.empty(4, 6, device="meta"))
    assert encoded.device.type == "meta" and encoded.shape == (4, 6)
    assert space.encode(space.low).device.type == "cpu"


def test_encoding_exports_with_a_dynamic_batch(space):
    class Encoder(torch.nn.Module):
        def forward(self, theta):
            return space.encode(theta)

    batch = torch.export.Dim("batch", min=2, max=64)
    program = torch.export.export(Encoder(), (space.sample((4,)),), dynamic_shapes=({0: batch},))
    theta = space.sample((7,))
    torch.testing.assert_close(program.module()(theta), space.encode(theta), rtol=0, atol=0)


def test_make_fills_in_defaults(space):
    assert space.make().equal(space.default)
    theta = space.make(pose="up", fuel=10)
    assert theta.dtype == torch.float32
    assert theta.tolist() == [0, 0, 1, 0.5, 0.5, 10]


def test_make_clamps_with_a_warning_or_raises(space):
    with pytest.warns(StyleRangeWarning, match=r"step_length = 0\.9 m lies outside \[0\.25, 0\.75\] m"):
        assert space.make(step_length=0.9)[3] == 0.75
    with pytest.raises(ValueError, match=r"step_length = 0\.9 m lies outside .* strict=False"):
        space.make(strict=True, step_length=0.9)


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"steplength": 0.5}, r"unknown style parameter 'steplength'.*'step_length'"),
        ({"pose": "y_pose"}, r"pose = 'y_pose' is not an option.*'t_pose'"),
        ({"pose": 1}, "is not an option"),
        ({"gap": "far"}, r"gap = 'far' is not a number.*\[0\.0, 2\.0\]"),
        ({"gap": float("nan")}, r"NaN in \['gap'\]"),
    ],
)
def test_make_rejects(space, values, message, strict):
    with pytest.raises(ValueError, match=message):
        space.make(strict=strict, **values)


def test_clamp_leaves_valid_styles_alone(space):
    theta = space.sample((5,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clamped = space.clamp(theta)
    assert clamped.equal(theta) and clamped.data_ptr() != theta.data_ptr()
    space.validate(theta)


def test_clamp_names_every_change_of_a_batch(space):
    theta = space.default.repeat(4, 1)
    theta[1, 3], theta[2, 3], theta[3, 5] = 0.9, 1.25, float("inf")
    with pytest.warns(StyleRangeWarning, match=r"step_length = 0\.5 to 1\.25 m .*; fuel = 0 to inf lies"):
        clamped = space.clamp(theta)
    assert clamped[:, 3].tolist() == [0.5, 0.75, 0.75, 0.5]
    assert clamped[:, 5].tolist() == [0, 0, 0, 105]
    assert theta[1, 3] == pytest.approx(0.9)  # the caller's tensor is untouched
    with pytest.raises(ValueError, match="strict=False"):
        space.clamp(theta, strict=True)


def test_clamp_makes_a_one_hot_of_the_largest_entry(space):
    theta = space.default
    theta[:3] = torch.tensor([0.2, 0.3, 4.0])
    with pytest.warns(StyleRangeWarning, match="pose is not a one-hot of its 3 options"):
        assert space.clamp(theta)[:3].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("theta", "message"),
    [
        (torch.zeros(5), r"shape \(5,\).*expected \(\.\.\., 6\)"),
        (torch.zeros(()), "expected"),
        (torch.zeros(6, dtype=torch.long), "floating point"),
        (torch.full((2, 6), float("nan")), "NaN"),
        (torch.zeros(6), "pose is not a one-hot"),
        (torch.tensor([1.0, 1.0, 0.0, 0.5, 0.0, 0.0]), "pose is not a one-hot"),
        (torch.tensor([1.0, 0.0, 0.0, 0.5, -0.1, 0.0]), r"gap = -0\.1 m lies outside \[0, 2\] m"),
    ],
)
def test_validate_rejects(space, theta, message):
    with pytest.raises(ValueError, match=message):
        space.validate(theta)


def test_bounds_are_compared_in_float32(space):
    """0.65 in float64 exceeds 0.65 in float32: that is no violation."""
    narrow = StyleSpace([Setpoint("length", 0.3, 0.65)])
    narrow.validate(torch.tensor([0.65], dtype=torch.float64))
    narrow.validate(torch.tensor([0.3], dtype=torch.float64))


def test_view_names_the_blocks(space):
    theta = space.sample((2, 3))
    view = space.view(theta)
    assert {name: tuple(block.shape) for name, block in view.items()} == {
        "pose": (2, 3, 3),
        "step_length": (2, 3),
        "gap": (2, 3),
        "fuel": (2, 3),
    }
    assert view["gap"].equal(theta[..., 4]) and len(view) == 4
    with pytest.raises(KeyError, match="no style parameter named speed: expected pose, step_length"):
        view["speed"]


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        (("pose", "step_length", "gap", "fuel"), [0, 1, 2, 3, 4, 5]),
        (("gap", "fuel"), [4, 5]),
        (("fuel", "pose"), [5, 0, 1, 2]),
        (("fuel", "gap", "step_length", "pose"), [5, 4, 3, 0, 1, 2]),
    ],
)
def test_view_block(space, names, columns):
    theta = space.sample((3,))
    assert space.view(theta).block(names).equal(theta[..., columns])


def test_describe_and_make_are_inverse(space):
    theta = space.make(pose="front", step_length=0.3, fuel=-2)
    described = space.describe(theta)
    assert described["pose"] == "front" and described["fuel"] == -2.0
    assert space.make(strict=True, **described).equal(theta)
    with pytest.raises(ValueError, match=r"expected \(6,\)"):
        space.describe(theta.repeat(2, 1))


def test_default_sampler_is_uniform_and_independent(space):
    theta = space.sample((20_000,), torch.Generator().manual_seed(0))
    space.validate(theta)
    width = space.high - space.low
    # 5 standard errors of a Bernoulli(1/3) and of a uniform variable
    assert (theta[:, :3].mean(0) - 1 / 3).abs().max() < 5 * (2 / 9 / 20_000) ** 0.5
    middle = (space.low + space.high) / 2
    assert ((theta.mean(0) - middle).abs()[3:] < 5 * width[3:] / (12 * 20_000) ** 0.5).all()
    correlation = torch.corrcoef(theta[:, 3:].T) - torch.eye(3)
    assert correlation.abs().max() < 5 / 20_000**0.5


def test_json_round_trip_with_sampler(space):
    low, high = [-0.1, -0.2], [1.0, 2.0]
    mixed = StyleSpace(
        [Weight("a", -0.1, 1.0), Weight("b", -0.2, 2.0)],
        Mixture([PointMass([0.0, 0.0]), Uniform(low, high), ContinuousOneHot(low, high)], [0.03, 0.1, 0.87]),
    )
    for original in (space, mixed):
        text = original.to_json()
        revived = StyleSpace.from_json(text)
        assert revived == original and hash(revived) == hash(original)
        assert original.to_dict() == json.loads(text)
        assert revived.low.equal(original.low) and revived.default.equal(original.default)
        draws = [s.sample((9,), torch.Generator().manual_seed(1)) for s in (original, revived)]
        assert draws[0].equal(draws[1])


def test_copies_are_equal(space):
    for twin in (copy.deepcopy(space), pickle.loads(pickle.dumps(space))):
        assert twin == space and twin.encode(space.default).equal(space.encode(space.default))


def test_unreadable_descriptions_are_rejected(space):
    description = space.to_dict()
    with pytest.raises(ValueError, match=r"schema version 99.*reads version 1"):
        StyleSpace.from_dict({**description, "version": 99})
    with pytest.raises(ValueError, match=r"kind 'knob'.*'choice'"):
        StyleSpace.from_dict({**description, "parameters": [{"kind": "knob"}]})
    with pytest.raises(ValueError, match=r"unknown sampler type 'Levy'.*'Uniform'"):
        StyleSpace.from_dict({**description, "sampler": {"type": "Levy"}})


def test_equal_spaces_do_not_differ(space):
    assert space.difference(StyleSpace.from_json(space.to_json())) == []


def test_difference_reads_as_sentences():
    here = StyleSpace(
        [
            Choice("pose", ("front", "up")),
            Setpoint("length", 0.3, 0.6, unit="m"),
            Weight("fuel", -1, 1),
            Weight("x", 0, 1),
        ]
    )
    there = StyleSpace(
        [
            Weight("fuel", -1, 1),
            Setpoint("length", 0.3, 0.8, unit="m", default=0.45),
            Weight("pose", 0, 1),
            Weight("y", 0, 1),
        ],
        name="old",
    )
    sentences = here.difference(there)
    assert sentences[:6] == [
        "The space is called '' here, 'old' there.",
        "x exists only here.",
        "y exists only there.",
        "The parameters are ordered pose, length, fuel here, fuel, length, pose there.",
        "pose is a choice here, a weight there.",
        "length ranges over [0.3, 0.6] m here, over [0.3, 0.8] m there.",
    ]
    assert len(sentences) == 7 and sentences[6].startswith("Styles are drawn from Product")


def test_difference_of_defaults_options_and_encoding():
    here = StyleSpace([Choice("pose", ("a", "b")), Setpoint("length", 0, 1, encoding="range")])
    there = StyleSpace([Choice("pose", ("a", "c")), Setpoint("length", 0, 1, unit="m", default=0.25)])
    assert here.difference(there) == [
        "pose offers [a, b] here, [a, c] there.",
        "length defaults to 0.5 here, 0.25 there.",
        "length is encoded by 'range' here, 'max' there.",
        "length has the unit '' here, 'm' there.",
    ]


def test_encodes_like_ignores_what_networks_do_not_see(space):
    parameters = [Choice("pose", ("a", "b")), Setpoint("length", 0.3, 0.6)]
    base = StyleSpace(parameters)
    renamed = StyleSpace(parameters, Product([UniformChoice(2), PointMass(0.5)]), name="other")
    assert base.encodes_like(renamed) and base != renamed
    assert not base.encodes_like(StyleSpace([parameters[0], Setpoint("length", 0.3, 0.7)]))
    assert not base.encodes_like(StyleSpace(parameters[::-1]))
    assert not base.encodes_like(StyleSpace([Choice("pose", ("b", "a")), parameters[1]]))


@pytest.mark.parametrize(
    ("declare", "message"),
    [
        (lambda: Weight("w", 1.0, 1.0), "finite bounds with low < high"),
        (lambda: Weight("w", 0.0, float("inf")), "finite bounds"),
        (lambda: Weight("w", 0.5, 1.0), r"lacks the neutral value 0.*Setpoint"),
        (lambda: Weight("step length", 0, 1), "Python identifier"),
        (lambda: Weight("strict", 0, 1), "is not usable"),
        (lambda: Weight("w", 0, 1, evaluation=(0, 2)), "evaluation bound of Weight 'w' is 2.0"),
        (lambda: Setpoint("s", 0, 1, default=2), "default of Setpoint 's' is 2.0"),
        (lambda: Setpoint("s", 0, 1, encoding="log"), "expected 'max' or 'range'"),
        (lambda: Setpoint("s", 0, 1, unit=3), "unit of Setpoint 's' is 3: expected a text"),  # pyright: ignore
        (lambda: Choice("c", ("a", "b"), help=None), "help of Choice 'c' is None: expected a text"),  # pyright: ignore
        (lambda: Choice("c", ("a",)), "at least two distinct names"),
        (lambda: Choice("c", ("a", "a")), "at least two distinct names"),
        (lambda: Choice("c", "ab"), "at least two distinct names"),
        (lambda: Choice("c", ("a", "b"), default="z"), r"default of Choice 'c' is 'z'"),
        (lambda: StyleSpace([]), "at least one"),
        (lambda: StyleSpace([Weight("w", 0, 1), Weight("w", 0, 2)]), "distinct names"),
    ],
)
def test_declarations_are_checked(declare, message):
    with pytest.raises(ValueError, match=message):
        declare()


@pytest.mark.parametrize(
    ("sampler", "message"),
    [
        (Uniform(0, 1), "draws 1 numbers.*need 3"),
        (Product([Uniform(0.3, 0.6), UniformChoice(2)]), "pose is not a one-hot"),
        (Product([UniformChoice(2), Uniform(0.3, 0.9)]), r"length = .* lies outside \[0\.3, 0\.6\]"),
        # too rare for a trial draw, found by its support
        (
            Product([UniformChoice(2), Mixture([PointMass(0.5), PointMass(0.9)], [1 - 1e-6, 1e-6])]),
            r"length = 0\.9 lies outside",
        ),
    ],
)
def test_sampler_must_fit_the_parameters(sampler, message):
    with pytest.raises(ValueError, match=message):
        StyleSpace([Choice("pose", ("a", "b")), Setpoint("length", 0.3, 0.6)], sampler)
