"""Mirror images of batches."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from coachable.transforms.mirror import MirrorMap, MirrorSymmetry

SWAP = MirrorMap(source=(1, 0, 2), sign=(-1, -1, 1))


def batch(n=2000):
    return TensorDict({"action": torch.randn(n, 3), "next": {"observation": torch.randn(n, 3)}}, [n])


def test_half_of_a_batch_is_mirrored_unless_told_otherwise():
    mirror, data = MirrorSymmetry({"action": SWAP, ("next", "observation"): SWAP}), batch()
    out = mirror(data.clone())
    changed = (out["action"] != data["action"]).any(-1)
    assert abs(changed.float().mean() - 0.5) < 5 * 0.5 / 2000**0.5
    for key in ("action", ("next", "observation")):
        assert torch.equal(out[key][~changed], data[key][~changed])
        image = torch.stack([-data[key][:, 1], -data[key][:, 0], data[key][:, 2]], -1)
        assert torch.equal(out[key][changed], image[changed])


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_all_or_nothing(probability):
    data = batch(50)
    out = MirrorSymmetry({"action": SWAP}, probability)(data.clone())
    assert (out["action"] != data["action"]).any(-1).float().mean() == probability
    assert torch.equal(out["next", "observation"], data["next", "observation"]), "no map, no image"


@pytest.mark.parametrize(
    "source, sign",
    [
        ((1, 2, 0), (1, 1, 1)),  # a rotation
        ((1, 0), (1, -1)),  # the way back has another sign
        ((0, 1), (2, 1)),
        ((1, 0), (-1, -2)),
    ],
)
def test_mirroring_twice_must_be_nothing(source, sign):
    with pytest.raises(ValueError, match="not each other's mirror image"):
        MirrorMap(source, sign)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="as many signs as sources, got 1, 2"):
        MirrorMap((0, 1), (1,))
    with pytest.raises(ValueError, match="'action' has 3 entries, its mirror map 2"):
        MirrorSymmetry({"action": MirrorMap((0, 1), (1, 1))})(batch(5))


def test_missing_entries_are_passed_over():
    data = batch(5)
    out = MirrorSymmetry({"style_features": SWAP, "action": SWAP}, 1.0)(data.clone())
    assert set(out.keys(True)) == set(data.keys(True))


def test_the_state_continues():
    first, data = MirrorSymmetry({"action": SWAP}, seed=3), batch(50)
    first(data)
    other = MirrorSymmetry({"action": SWAP})
    other.load_state_dict(first.state_dict())
    assert torch.equal(other(data)["action"], first(data)["action"])


def test_in_an_environment_it_is_refused(make_base_env):
    env = TransformedEnv(make_base_env(), MirrorSymmetry({"action": MirrorMap((0,), (-1.0,))}))
    with pytest.raises(RuntimeError, match="give it to a replay buffer"):
        env.reset()
