"""Files from anybody: nothing in them is executed, and nothing outside of them is touched."""

import copy
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from recipe_config import compose_config
from recipe_saved import CONFIGS, check_saved_config, known_targets

from coachable.coach.session.session import CoachSession
from coachable.domains.humanoid import humanoid_style_space
from coachable.files import CheckpointError, check_contained, load_state
from coachable.replay import EventTableBuffer
from coachable.styles import StyleSpace
from coachable.training.checkpoint import find_checkpoint
from coachable.training.weights import load_policy
from tests.training.foreign import RECIPE, changed, openers, put, resume


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


@pytest.mark.parametrize(
    "wrap", [lambda x: x, lambda x: [x], lambda x: ({"deeper": [x]},)], ids=["plain", "list", "tuple"]
)
def test_no_target_of_a_saved_configuration_is_called(trained, tmp_path, wrap):
    marker = tmp_path / "marker"
    whole = load_state(find_checkpoint(trained) / "state.pt")["config"]
    for payload in _payloads(tmp_path, marker).values():
        for place in PLACES:
            config = copy.deepcopy(whole)
            put(config, place, wrap(payload))
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
    changed(find_checkpoint(run) / "state.pt", lambda state: put(state["config"], place, harm))
    with pytest.raises(CheckpointError, match="names '"):
        resume(run)
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
    changed(find_checkpoint(run) / "state.pt", lambda state: put(state["config"], "wandb.project", text))
    with pytest.raises(CheckpointError, match=r"as its wandb.project: expected a plain value"):
        resume(run)
    assert (run / "config.json").read_bytes() == before


def test_a_configuration_cannot_choose_the_folder(run):
    for domain in ("../../elsewhere", "/tmp/elsewhere", 7, None):
        changed(find_checkpoint(run) / "state.pt", lambda state, d=domain: put(state["config"], "domain", d))
        if domain is not None and not isinstance(domain, int):
            with pytest.raises(CheckpointError, match="holds no configuration of a training"):
                resume(run)


def test_groups_of_another_kind_are_refused(run):
    for group in ("network", "train"):
        changed(find_checkpoint(run) / "state.pt", lambda state, g=group: put(state["config"], g, "text"))
        with pytest.raises(CheckpointError, match="frames_000000000040 holds a configuration"):
            resume(run)


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
            put(state["config"], place, {"_target_": own, "names": ["a"]})

    changed(find_checkpoint(run) / "state.pt", change)
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
    for name, opener in (openers(tmp_path) | {"resume": resume}).items():
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
            resume(run)
        (replay / file).write_bytes(kept)
    assert not marker.exists()
    assert resume(run).frames == 40


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
    changed(file, lambda state: put(state, "network.actor._target_", target))
    for opener in (load_policy, CoachSession.open, openers(tmp_path)["export"]):
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
    for opener in (load_policy, resume):
        with pytest.raises(CheckpointError, match="expected a "):
            opener(run)


@pytest.mark.parametrize("name", ["metrics.csv", "config.json", "checkpoints/.LATEST.partial"])
def test_a_resumed_run_writes_into_its_own_folder_only(run, name):
    outside = run.parent / "precious"
    outside.write_text("keep me")
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(outside)
    with pytest.raises(CheckpointError, match=r"is a link to \S+precious, outside of"):
        resume(run)
    assert outside.read_text() == "keep me"


def test_links_within_a_run_are_fine(run):
    (run / "latest.csv").symlink_to("metrics.csv")
    check_contained(run)


def test_a_run_that_was_logged_at_wandb_is_resumed(run):
    (run.parent / "elsewhere").mkdir()
    logs = run / "wandb" / "run-20260101_000000-abc" / "logs"
    logs.mkdir(parents=True)
    (logs / "debug-core.log").symlink_to(run.parent / "elsewhere" / "core-debug.log")  # as W&B does
    resume(run)
    shutil.rmtree(run / "wandb")
    (run / "wandb").symlink_to(run.parent / "elsewhere")
    with pytest.raises(CheckpointError, match=r"is a link to \S+elsewhere, outside of"):
        resume(run)


@pytest.mark.parametrize("key", ["../../outside", "/tmp/outside", "..", ""])
def test_entries_of_a_replay_buffer_lie_in_its_folder(run, key):
    replay = find_checkpoint(run) / "replay"
    index = json.loads((replay / "index.json").read_text())
    index["entries"][0]["key"] = [key]
    (replay / "index.json").write_text(json.dumps(index))
    np.save(run.parent / "outside.npy", np.zeros(3))
    with pytest.raises(CheckpointError):
        resume(run)
