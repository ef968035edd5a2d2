"""Files that are damaged or do not fit: one sentence says what is wrong, and none like them is written."""

import os
import random
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from recipe_config import run_recipe

from coachable import files
from coachable.cli import main
from coachable.domains.humanoid import humanoid_style_space
from coachable.evaluation.curves import read_metric
from coachable.files import CheckpointError, load_state, save_state
from coachable.networks import make_gaussian_actor
from coachable.training.checkpoint import CheckpointStore, find_checkpoint, read_state
from coachable.training.weights import domain_of, load_policy
from tests.echo import make_train
from tests.training.foreign import RECIPE, changed, openers, put

NAN, INFINITY = float("nan"), float("inf")


def test_flipped_bytes_never_pass_silently(shipped, tmp_path):
    """Two bytes anywhere: the file is refused, or what they changed is no part of its content."""
    whole, expected = shipped.read_bytes(), load_policy(shipped)
    generator, refused = random.Random(0), 0
    for _ in range(150):
        damaged = bytearray(whole)
        for at in generator.sample(range(len(whole)), 2):
            damaged[at] ^= 1 << generator.randrange(8)
        (tmp_path / "weights.pt").write_bytes(damaged)
        try:
            state = read_state(tmp_path / "weights.pt")
        except CheckpointError:
            refused += 1
        else:
            assert state["space"] == expected.space.to_dict() and state["domain"] == "humanoid"
            for name, value in expected.actor.state_dict().items():
                assert torch.equal(state["actor"][name], value)
    assert refused > 75


def _flipped(content):
    damaged = np.frombuffer(content, np.uint8).copy()
    damaged[50::97] ^= 0x41
    return damaged.tobytes()


DAMAGE = {
    "cut in half": lambda file: os.truncate(file, file.stat().st_size // 2),
    "cut at the end": lambda file: os.truncate(file, file.stat().st_size - 1),
    "empty": lambda file: os.truncate(file, 0),
    "missing": Path.unlink,
    "text": lambda file: file.write_text("# not what you expect\n"),
    "list": lambda file: file.write_text("[1, 2]"),
    "null": lambda file: file.write_text("null"),
    "noise": lambda file: file.write_bytes(random.Random(1).randbytes(500)),
    "flipped": lambda file: file.write_bytes(_flipped(file.read_bytes())),
}
IGNORED = ("checkpoints/LATEST", "metadata.json")  # for people, or replaced by what is there
PARTS = (*IGNORED, "state.pt", "replay/state.pt", "replay/index.json", "replay/action.npy")


@pytest.fixture(scope="module")
def small_train(tmp_path_factory):
    """A training that resumes again and again."""
    return make_train(tmp_path_factory.mktemp("resumed"), total_frames=100)


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("part", PARTS)
def test_every_damaged_file_of_a_run_is_named_when_it_is_resumed(short_run, small_train, tmp_path, part, damage):
    run = Path(shutil.copytree(short_run, tmp_path / "run"))
    file = run / part if part == "checkpoints/LATEST" else find_checkpoint(run) / part
    DAMAGE[damage](file)
    if part in IGNORED:
        assert small_train.resume(run).name == "frames_000000000080"
        return
    with pytest.raises(CheckpointError) as refusal:
        small_train.resume(run)
    _assert_one_sentence(refusal.value, run if damage == "missing" else file)


def test_a_run_resumes_without_its_replay_buffer(short_run, small_train, tmp_path):
    run = Path(shutil.copytree(short_run, tmp_path / "run"))
    shutil.rmtree(find_checkpoint(run) / "replay")
    with pytest.warns(UserWarning, match="the checkpoint has no replay buffer"):
        small_train.resume(run)


@pytest.mark.parametrize("damage", DAMAGE)
def test_every_opener_names_a_damaged_file(shipped, tmp_path, damage):
    for name, opener in openers(tmp_path).items():
        file = Path(shutil.copy(shipped, tmp_path / f"{name}.pt"))
        DAMAGE[damage](file)
        with pytest.raises(CheckpointError) as refusal:
            opener(file)
        _assert_one_sentence(refusal.value, file.name)


def _assert_one_sentence(error, name):
    text = str(error)
    assert str(name) in text and "\n" not in text and len(text) < 600, text


def _other_observation(state):
    state["network"]["actor"]["obs_dim"] = 85
    state["actor"] = dict(make_gaussian_actor(85, 21, humanoid_style_space(), [8]).state_dict())


CHANGES = {
    "another schema": (lambda s: put(s, "schema", 0), "has schema 0, this version of coachable reads schema 1"),
    "no schema": (lambda s: s.pop("schema"), "has schema None"),
    "no critics": (lambda s: s.pop("critics"), "does not describe a policy: it lacks critics"),
    "numbers for weights": (lambda s: put(s, "actor", 7), "has a int as its actor: expected a dict"),
    "another space": (
        lambda s: put(s["space"]["parameters"][0], "name", "hat"),
        r"has the styles hat \(.*humanoid has pose",
    ),
    "an older space": (lambda s: put(s, "space.version", 0), "style space has schema version 0"),
    "half a space": (lambda s: put(s, "space", {}), "style space"),
    "other observations": (_other_observation, "reads 85 observations and gives 21 actions: expected 82 and 21"),
    "other widths": (lambda s: put(s, "network.actor.widths", [9]), r"is \(8, 86\) in the checkpoint, \(9, 86\) here"),
    "huge widths": (lambda s: put(s, "network.actor.widths", [10**7, 10**7]), "in the checkpoint"),
    "no widths": (lambda s: put(s, "network.actor.widths", "wide"), "holds a network that cannot be used"),
    "unknown domain": (lambda s: put(s, "domain", "chess"), "unknown domain 'chess': expected one of"),
    "domain of a kind": (lambda s: put(s, "domain", ["humanoid"]), "has a list as its domain: expected a str"),
    "NaN": (
        lambda s: s["actor"]["module.0.module.trunk.head.bias"].fill_(NAN),
        r"42 of 42 values of actor\..*NaN or infinite",
    ),
    "infinity": (lambda s: s["critics"]["x"].fill_(INFINITY), r"2 of 2 values of critics\.x are NaN or infinite"),
    "integers": (
        lambda s: s.update(actor={k: v.long() for k, v in s["actor"].items()}),
        "not a tensor of torch.float32",
    ),
    "text": (lambda s: s.update(actor=dict.fromkeys(s["actor"], "x")), "not a tensor of torch.float32"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_does_not_fit_is_one_sentence_at_the_command_line(shipped, tmp_path, change, capsys):
    file = Path(shutil.copy(shipped, tmp_path))
    changed(file, CHANGES[change][0])
    assert (
        main(["evaluate", str(file), "--out", str(tmp_path / "out"), "--episodes", "1", "--switch-episodes", "1"]) == 2
    )
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and (str(file) in error or "unknown domain" in error), error
    commands = [["weights", str(file), str(tmp_path / "x")]]
    if change != "unknown domain":  # that one is somebody's own
        commands.append(["export", "onnx", str(file), "--out", str(tmp_path / "x")])
    for command in commands:
        assert main(command) == 2
        assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises((CheckpointError, ValueError), match=CHANGES[change][1]):
        domain_of(load_policy(file)).make_env(num_envs=1, num_threads=1)


LOOP = [
    "loop",
    "loop.frames",
    "learner",
    "learner.updates",
    "learner.optimizers",
    "collector.frames",
    "rng",
    "rng.torch",
]


@pytest.mark.parametrize("place", LOOP)
def test_a_state_of_another_kind_is_refused(short_run, small_train, tmp_path, place):
    run = Path(shutil.copytree(short_run, tmp_path / "run"))
    whole = read_state(find_checkpoint(run))
    first, _, second = place.partition(".")
    for value in ("x", None, [1], {}):
        changed = {**whole, first: {**whole[first], second: value} if second else value}
        torch.save(changed, find_checkpoint(run) / "state.pt")
        with pytest.raises(CheckpointError) as refusal:
            small_train.resume(run)
        _assert_one_sentence(refusal.value, find_checkpoint(run))


def test_a_recipe_ends_with_one_sentence(run, monkeypatch, capsys):
    DAMAGE["flipped"](find_checkpoint(run) / "state.pt")
    monkeypatch.setattr(sys, "argv", ["rare_targets.py", f"resume={run}"])
    with pytest.raises(SystemExit, match=r"^error: \S+state\.pt is damaged, .*agrees with its checksums$"):
        run_recipe(RECIPE, partial(pytest.fail, "a damaged run was built"))


def test_a_damaged_table_of_metrics_is_named(run):
    (run / "metrics.csv").write_bytes(b"updates,y\n1,2\nx,3\n")
    with pytest.raises(ValueError, match=r"metrics.csv is damaged: could not convert string to float: 'x'"):
        read_metric(run, "updates", "y")
    (run / "metrics.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"metrics.csv is not a table of metrics"):
        read_metric(run, "updates", "y")


# -- what is written ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["actor", "critics", "learner"])
@pytest.mark.parametrize("value", [NAN, INFINITY])
def test_weights_that_are_not_finite_replace_no_checkpoint(tmp_path, part, value):
    store = CheckpointStore(tmp_path, keep=1)
    good = {"actor": {"x": torch.ones(3)}, "critics": {}, "learner": {}}
    store.save(good, {"frames": 1})
    bad = {**good, part: {"nested": [torch.tensor([1.0, value])]}}
    for save in (store.save, store.try_save):
        with pytest.raises(
            CheckpointError, match=rf"no checkpoint was written, \S+1 is kept: .* 1 of 2 values of {part}\."
        ):
            save(bad, {"frames": 2})
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["LATEST", "frames_000000000001"]
    assert read_state(find_checkpoint(tmp_path))["actor"]["x"].tolist() == [1, 1, 1]


def test_a_tensor_that_repeats_its_numbers_is_saved_with_all_of_them_and_else_refused(tmp_path):
    """An expanded tensor of 1.5 kB would become one of gigabytes as soon as it is copied."""
    file = tmp_path / "state.pt"
    torch.save({"list": [torch.zeros(1).expand(2**31)]}, file)
    with pytest.raises(CheckpointError, match=r"state\.pt, list, 0 has 4 bytes for the shape \(2147483648,\)"):
        load_state(file)
    save_state({"list": [torch.ones(1).expand(3)], "view": torch.arange(4)[1:]}, file)
    state = load_state(file)
    assert state["list"][0].tolist() == [1, 1, 1] and state["view"].tolist() == [1, 2, 3]


def test_containers_that_contain_each_other_are_refused(tmp_path, monkeypatch):
    """Thirty nested lists with two times the same list each have 2 ** 30 entries, and one inside itself has no end."""
    monkeypatch.setattr(files, "_MOST_ENTRIES", 10_000)
    nested: list = []
    for _ in range(30):
        nested = [nested, nested]
    torch.save({"nested": nested}, tmp_path / "nested.pt")
    with pytest.raises(CheckpointError, match="is one entry too many: expected at most 10,000 in a file"):
        load_state(tmp_path / "nested.pt")
    endless: list = []
    endless += [endless, endless]
    torch.save({"endless": endless}, tmp_path / "endless.pt")
    with pytest.raises(CheckpointError, match="endless"):
        load_state(tmp_path / "endless.pt")


def test_objects_that_could_not_be_read_back_are_not_saved(tmp_path):
    with pytest.raises(CheckpointError, match="env is a float64: expected tensors, numbers"):
        CheckpointStore(tmp_path).save({"collector": {"env": np.float64(1.0)}}, {"frames": 1})
