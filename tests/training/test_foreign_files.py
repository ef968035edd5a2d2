"""Files from anybody: nothing in them is executed, nothing outside of them is touched, and damage is one sentence."""

import copy
import json
import os
import pickle
import random
import shutil
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from recipe_config import build_checked, compose_config, run_recipe
from recipe_saved import CONFIGS, check_saved_config, known_targets

from coachable.cli import main
from coachable.coach.session.session import CoachSession
from coachable.domains.humanoid import humanoid_style_space
from coachable.evaluation.curves import read_metric
from coachable.evaluation.evaluate import evaluate
from coachable.evaluation.report import report
from coachable.evaluation.video import render
from coachable.export.onnx import export
from coachable.files import CheckpointError, check_contained, load_state, save_state
from coachable.networks import make_gaussian_actor
from coachable.replay import EventTableBuffer
from coachable.styles import StyleSpace
from coachable.training.checkpoint import CheckpointStore, find_checkpoint, read_state
from coachable.training.weights import domain_of, export_weights, initialise_from, load_policy
from tests.echo import make_train

RECIPE = "rare_targets"
TINY = ["preset=smoke", "threads.learner=1", "threads.simulator=1", "train.eval_interval=0", "eval.max_steps=5"]
TINY += [
    "init_random_frames=8",
    "train.warmup_frames=8",
    "train.batch_size=18",
    "train.total_frames=40",
    "event_capacity=100",
]
NAN, INFINITY = float("nan"), float("inf")


def _build(config):
    import rare_targets

    return build_checked(rare_targets.build, config)


def _resume(run):
    return _build(compose_config(RECIPE, [f"resume={run}", "train.total_frames=60"]))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of a recipe with event tables."""
    run = tmp_path_factory.mktemp("trained") / "run"
    _build(compose_config(RECIPE, [*TINY, f"run_dir={run}"])).run()
    return run


@pytest.fixture
def run(trained, tmp_path):
    """A copy of that run, to be damaged."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """A small untrained humanoid as a weights file."""
    space, widths = humanoid_style_space(), [8]
    actor = make_gaussian_actor(82, 21, space, widths)
    target = {"_target_": "coachable.networks.make_gaussian_actor", "obs_dim": 82, "action_dim": 21, "widths": widths}
    file = tmp_path_factory.mktemp("weights") / "weights.pt"
    agent = {"domain": "humanoid", "space": space.to_dict(), "network": {"actor": target}, "config": {"env": {}}}
    weights = {"actor": dict(actor.state_dict()), "critics": {"x": torch.zeros(2)}}
    save_state({"schema": 1, **agent, **weights, "counters": {"frames": 1, "updates": 1}}, file)
    return file


def _changed(file, change):
    state = torch.load(file, weights_only=True)
    change(state)
    torch.save(state, file)


def _openers(out):
    """Every function that opens an agent, by the name of its command."""
    return {
        "load_policy": load_policy,
        "export": lambda source: export(source, out / "policy.onnx"),
        "weights": lambda source: export_weights(source, out / "weights.pt"),
        "evaluate": lambda source: evaluate(source, out / "evaluation", episodes=1, progress=False),
        "report": lambda source: report([source], out / "report", progress=False),
        "render": lambda source: render(source, out / "film.png", progress=False),
        "coach": CoachSession.open,
        "init_from": lambda source: initialise_from(
            source, torch.nn.Module(), torch.nn.Module(), humanoid_style_space()
        ),
    }


def _payloads(folder: Path, marker: Path):
    """What a configuration may call to create the marker; hydra's own list of forbidden names stops few of them."""

    class Harmful:
        def __reduce__(self):
            return Path.touch, (marker,)

    (folder / "harmful.pickle").write_bytes(pickle.dumps(Harmful()))
    torch.save(Harmful(), folder / "harmful.pt")
    np.save(folder / "harmful.npy", np.array([Harmful()], dtype=object), allow_pickle=True)
    (folder / "hubconf.py").write_text(
        f"from pathlib import Path\ndef touch(**_):\n    Path({str(marker)!r}).touch()\n"
    )
    path = {"_target_": "pathlib.Path", "_args_": [str(marker)]}
    later = {"_target_": "hydra.utils.get_method", "path": "os.mkdir"}
    return {
        "sorted": {"_target_": "builtins.sorted", "_args_": [[str(marker)]], "key": later},
        "torch.load": {"_target_": "torch.load", "f": str(folder / "harmful.pt"), "weights_only": False},
        "numpy.load": {"_target_": "numpy.load", "file": str(folder / "harmful.npy"), "allow_pickle": True},
        "torch.hub": {"_target_": "torch.hub.load", "repo_or_dir": str(folder), "model": "touch", "source": "local"},
        "our own": {"_target_": "coachable.files.write_text", "file": path, "text": "harm"},
    }


# -- configurations ----------------------------------------------------------------------------------------------------

GROUPS = [
    "env",
    "loss",
    "network.actor",
    "network.critic",
    "learner",
    "replay",
    "replay.events",
    "sampler",
    "collector",
]
GROUPS += ["events", "train"]
PLACES = [*GROUPS, *(f"{group}.nested" for group in GROUPS), "style_reward.scale", "new", "seed", "eval.max_steps"]


def _put(config, place, value):
    *parents, last = place.split(".")
    for parent in parents:
        config = config[parent]
    config[last] = value


@pytest.mark.parametrize(
    "wrap", [lambda x: x, lambda x: [x], lambda x: ({"deeper": [x]},)], ids=["plain", "list", "tuple"]
)
def test_no_target_of_a_saved_configuration_is_called(trained, tmp_path, wrap):
    marker = tmp_path / "marker"
    whole = load_state(find_checkpoint(trained) / "state.pt")["config"]
    for payload in _payloads(tmp_path, marker).values():
        for place in PLACES:
            config = copy.deepcopy(whole)
            _put(config, place, wrap(payload))
            with pytest.raises(
                CheckpointError, match=r"^\S+ names '.*' as its .*_target_: expected .* yourself if you"
            ):
                check_saved_config(config, tmp_path, RECIPE, said=["eval.num_envs", "threads"])
    check_saved_config(whole, tmp_path, RECIPE)
    assert not marker.exists()


@pytest.mark.parametrize(
    "payload, place",
    [
        ("sorted", "env"),
        ("torch.load", "replay.events"),
        ("numpy.load", "loss.nested"),
        ("torch.hub", "sampler"),
        ("our own", "train.nested"),
    ],
)
def test_resume_calls_nothing_of_a_saved_configuration(run, tmp_path, payload, place):
    marker = tmp_path / "marker"
    harm = _payloads(tmp_path, marker)[payload]
    _changed(find_checkpoint(run) / "state.pt", lambda state: _put(state["config"], place, harm))
    with pytest.raises(CheckpointError, match="names '"):
        _resume(run)
    assert not marker.exists()


@pytest.mark.parametrize("key", ["env.num_envs.x", "env._partial_", "_args_", "env._recursive_"])
def test_no_key_of_a_saved_configuration_is_special(trained, tmp_path, key):
    """A name with a dot is no place that the command line replaces."""
    config = load_state(find_checkpoint(trained) / "state.pt")["config"]
    config["env"][key] = {"_target_": "builtins.print"}
    with pytest.raises(CheckpointError):
        check_saved_config(config, tmp_path, RECIPE, said=["env.num_envs"])


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a ${seed} b", "${oc.create:{_target_:os.mkdir}}"])
def test_nothing_is_filled_in_to_a_saved_configuration(run, text):
    before = (run / "config.json").read_bytes()
    _changed(find_checkpoint(run) / "state.pt", lambda state: _put(state["config"], "wandb.project", text))
    with pytest.raises(CheckpointError, match=r"as its wandb.project: expected a plain value"):
        _resume(run)
    assert (run / "config.json").read_bytes() == before


def test_a_configuration_cannot_choose_the_folder(run):
    for domain in ("../../elsewhere", "/tmp/elsewhere", 7, None):
        _changed(find_checkpoint(run) / "state.pt", lambda state, d=domain: _put(state["config"], "domain", d))
        if domain is not None and not isinstance(domain, int):
            with pytest.raises(CheckpointError, match="holds no configuration of a training"):
                _resume(run)


def test_groups_of_another_kind_are_refused(run):
    for group in ("network", "train"):
        _changed(find_checkpoint(run) / "state.pt", lambda state, g=group: _put(state["config"], g, "text"))
        with pytest.raises(CheckpointError, match="frames_000000000040 holds a configuration"):
            _resume(run)


def test_what_the_yaml_files_name_is_known_at_its_place_only():
    known = known_targets("humanoid_sac")
    assert (("env", "_target_"), "coachable.envs.humanoid.HumanoidEnv") in known
    assert (("replay", "events", "_target_"), "coachable.domains.humanoid.humanoid_events") in known, "filled in"
    assert not any(place[0] == "env" and "HumanoidEnv" not in target for place, target in known)
    for file in CONFIGS.glob("*_*.yaml"):
        assert known_targets(file.stem), file


def test_targets_of_the_command_line_go_on_when_they_are_given_again(run):
    own = "coachable.replay.KeyEvents"

    def change(state):
        for place in ("events", "replay.events"):
            _put(state["config"], place, {"_target_": own, "names": ["a"]})

    _changed(find_checkpoint(run) / "state.pt", change)
    with pytest.raises(
        CheckpointError, match=f"names '{own}' as its events._target_: .* say events._target_={own} yourself"
    ):
        compose_config(RECIPE, [f"resume={run}"])
    config = compose_config(RECIPE, [f"resume={run}", f"events._target_={own}"])
    assert config["replay"]["events"] == config["events"] == {"_target_": own, "names": ["a"]}


# -- pickles -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["harmful.pt", "harmful.pickle", "harmful.npy"])
def test_no_opener_runs_a_pickle(run, tmp_path, kind):
    marker = tmp_path / "marker"
    _payloads(tmp_path, marker)
    openers = _openers(tmp_path) | {"resume": _resume}
    for name, opener in openers.items():
        if name != "resume":
            with pytest.raises(CheckpointError, match=rf"{kind}.*expected|cannot read \S+{kind}"):
                opener(tmp_path / kind)
        shutil.copy(tmp_path / kind, find_checkpoint(run) / "state.pt")
        with pytest.raises(CheckpointError):
            opener(run)
    assert not marker.exists()


@pytest.mark.filterwarnings("ignore::UserWarning")  # its environment saves no state
def test_no_pickle_of_a_replay_buffer_is_run(run, tmp_path):
    marker = tmp_path / "marker"
    _payloads(tmp_path, marker)
    replay = find_checkpoint(run) / "replay"
    for harmful, file in [
        ("harmful.pt", "state.pt"),
        ("harmful.npy", "observation.npy"),
        ("harmful.pickle", "action.npy"),
    ]:
        kept = (replay / file).read_bytes()
        shutil.copy(tmp_path / harmful, replay / file)
        with pytest.raises(CheckpointError):
            _resume(run)
        (replay / file).write_bytes(kept)
    assert not marker.exists()
    assert _resume(run).frames == 40


def test_memory_maps_with_code_are_not_opened(tmp_path):
    """As torchrl writes and reads them: types are evaluated, other objects unpickled."""
    marker, folder = tmp_path / "marker", tmp_path / "replay"
    _payloads(tmp_path, marker)
    (folder / "storage").mkdir(parents=True)
    harm = f"__import__('pathlib').Path({str(marker)!r}).touch()"
    for name in ("meta.json", "storage_metadata.json", "buffer.json", "index.json", "storage/meta.json"):
        described = {"_type": harm, "__type__": "torch.dtype", "value": harm, "batch_size": 1, "initialized": True}
        (folder / name).write_text(json.dumps(described))
    shutil.copy(tmp_path / "harmful.pickle", folder / "storage" / "other.pickle")
    with pytest.raises(CheckpointError, match="no such file"):
        EventTableBuffer({"default": 10}).loads(folder)
    assert not marker.exists()


def test_a_style_space_names_only_samplers(tmp_path):
    """The metadata of an exported model describe its space in this way, too."""
    description = humanoid_style_space().to_dict()
    for harm in ({"type": "os.system", "command": "x"}, {"type": "Uniform", "_target_": "os.system"}, "os.system", [1]):
        with pytest.raises((ValueError, TypeError, AttributeError)):
            StyleSpace.from_json(json.dumps({**description, "sampler": harm}))


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "coachable.fast.native.load",
        "coachable.networks.plain.torch.load",
        "torch.nn.Linear",
        None,
        ["x"],
    ],
)
def test_a_file_names_only_known_networks(shipped, tmp_path, target):
    file = Path(shutil.copy(shipped, tmp_path))
    _changed(file, lambda state: _put(state, "network.actor._target_", target))
    for opener in (load_policy, CoachSession.open, _openers(tmp_path)["export"]):
        with pytest.raises(CheckpointError):
            opener(file)


# -- paths -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "pointer", ["../../elsewhere", "/etc", "..", "frames_000000000040/../../..", "\0", "x" * 10_000]
)
def test_the_pointer_leads_nowhere_else(run, pointer):
    outside = run.parent / "elsewhere"
    shutil.copytree(find_checkpoint(run), outside)
    (run / "checkpoints" / "LATEST").write_text(pointer)
    assert find_checkpoint(run).parent == run / "checkpoints"


@pytest.mark.parametrize(
    "place", ["checkpoints", "checkpoints/frames_000000000040", "state.pt", "replay", "replay/action.npy"]
)
def test_links_out_of_a_run_are_refused(run, place):
    path = run / place if place.startswith("checkpoints") else find_checkpoint(run) / place
    outside = run.parent / "outside"
    path.rename(outside)
    path.symlink_to(outside)
    for opener in (load_policy, _resume):
        with pytest.raises(CheckpointError, match="expected a "):
            opener(run)


@pytest.mark.parametrize("name", ["metrics.csv", "config.json", "checkpoints/.LATEST.partial"])
def test_a_resumed_run_writes_into_its_own_folder_only(run, name):
    outside = run.parent / "precious"
    outside.write_text("keep me")
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(outside)
    with pytest.raises(CheckpointError, match=r"is a link to \S+precious, outside of"):
        _resume(run)
    assert outside.read_text() == "keep me"


def test_links_within_a_run_are_fine(run):
    (run / "latest.csv").symlink_to("metrics.csv")
    check_contained(run)


@pytest.mark.parametrize("key", ["../../outside", "/tmp/outside", "..", ""])
def test_entries_of_a_replay_buffer_lie_in_its_folder(run, key):
    replay = find_checkpoint(run) / "replay"
    index = json.loads((replay / "index.json").read_text())
    index["entries"][0]["key"] = [key]
    (replay / "index.json").write_text(json.dumps(index))
    np.save(run.parent / "outside.npy", np.zeros(3))
    with pytest.raises(CheckpointError):
        _resume(run)


# -- damage ------------------------------------------------------------------------------------------------------------


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
def small_run(tmp_path_factory):
    """A run of the library, without a recipe."""
    folder = tmp_path_factory.mktemp("small")
    make_train(folder / "run", total_frames=80).run()
    return folder / "run"


@pytest.fixture(scope="module")
def small_train(tmp_path_factory):
    """A training that resumes again and again."""
    return make_train(tmp_path_factory.mktemp("resumed"), total_frames=100)


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("part", PARTS)
def test_every_damaged_file_of_a_run_is_named_when_it_is_resumed(small_run, small_train, tmp_path, part, damage):
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
    file = run / part if part == "checkpoints/LATEST" else find_checkpoint(run) / part
    DAMAGE[damage](file)
    if part in IGNORED:
        assert small_train.resume(run).name == "frames_000000000080"
        return
    with pytest.raises(CheckpointError) as refusal:
        small_train.resume(run)
    _assert_one_sentence(refusal.value, run if damage == "missing" else file)


def test_a_run_resumes_without_its_replay_buffer(small_run, small_train, tmp_path):
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
    shutil.rmtree(find_checkpoint(run) / "replay")
    with pytest.warns(UserWarning, match="the checkpoint has no replay buffer"):
        small_train.resume(run)


@pytest.mark.parametrize("damage", DAMAGE)
def test_every_opener_names_a_damaged_file(shipped, tmp_path, damage):
    for name, opener in _openers(tmp_path).items():
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
    "another schema": (lambda s: _put(s, "schema", 0), "has schema 0, this version of coachable reads schema 1"),
    "no schema": (lambda s: s.pop("schema"), "has schema None"),
    "no critics": (lambda s: s.pop("critics"), "does not describe a policy: it lacks critics"),
    "numbers for weights": (lambda s: _put(s, "actor", 7), "has a int as its actor: expected a dict"),
    "another space": (
        lambda s: _put(s["space"]["parameters"][0], "name", "hat"),
        r"has the styles hat \(.*humanoid has pose",
    ),
    "an older space": (lambda s: _put(s, "space.version", 0), "style space has schema version 0"),
    "half a space": (lambda s: _put(s, "space", {}), "style space"),
    "other observations": (_other_observation, "reads 85 observations and gives 21 actions: expected 82 and 21"),
    "other widths": (lambda s: _put(s, "network.actor.widths", [9]), r"is \(8, 86\) in the checkpoint, \(9, 86\) here"),
    "huge widths": (lambda s: _put(s, "network.actor.widths", [10**7, 10**7]), "in the checkpoint"),
    "no widths": (lambda s: _put(s, "network.actor.widths", "wide"), "holds a network that cannot be used"),
    "unknown domain": (lambda s: _put(s, "domain", "chess"), "unknown domain 'chess': expected one of"),
    "domain of a kind": (lambda s: _put(s, "domain", ["humanoid"]), "has a list as its domain: expected a str"),
    "NaN": (
        lambda s: s["actor"]["module.0.module.trunk.head.bias"].fill_(NAN),
        r"42 of 42 values of actor\..*NaN or infinite",
    ),
    "infinity": (lambda s: s["critics"]["x"].fill_(INFINITY), r"2 of 2 values of critics\.x are NaN or infinite"),
    "integers": (lambda s: s.update(actor={k: v.long() for k, v in s["actor"].items()}), "no tensor of torch.float32"),
    "text": (lambda s: s.update(actor=dict.fromkeys(s["actor"], "x")), "no tensor of torch.float32"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_does_not_fit_is_one_sentence_at_the_command_line(shipped, tmp_path, change, capsys):
    file = Path(shutil.copy(shipped, tmp_path))
    _changed(file, CHANGES[change][0])
    assert (
        main(["evaluate", str(file), "--out", str(tmp_path / "out"), "--episodes", "1", "--switch-episodes", "1"]) == 2
    )
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and (str(file) in error or "unknown domain" in error), error
    for command in ("weights",) if change == "unknown domain" else ("weights", "export"):  # that one is somebody's own
        assert main([command, str(file), *(["--out"] if command == "export" else []), str(tmp_path / "x")]) == 2
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
def test_a_state_of_another_kind_is_refused(small_run, small_train, tmp_path, place):
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
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
    with pytest.raises(ValueError, match=r"metrics.csv is no table of metrics"):
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


def test_objects_that_could_not_be_read_back_are_not_saved(tmp_path):
    with pytest.raises(CheckpointError, match="env is a float64: expected tensors, numbers"):
        CheckpointStore(tmp_path).save({"collector": {"env": np.float64(1.0)}}, {"frames": 1})
