"""A training in stages: one run folder, resumed in any stage, bit for bit."""

import os
import shutil
import signal
import weakref
from importlib import import_module

import pytest
import torch
from recipe_config import compose_config, start_training

from coachable.training.checkpoint import CheckpointError, CheckpointStore, find_checkpoint, read_state
from coachable.training.curriculum import Curriculum
from coachable.training.hardware import Threads
from coachable.training.trainer import Trainer
from tests.random_kills import differences

TINY = ["preset=smoke", "threads.simulator=1", "threads.learner=1", "train.eval_interval=16", "eval.max_steps=3"]
TINY += ["init_random_frames=8", "train.warmup_frames=8", "train.batch_size=12", "train.utd_ratio=0.25"]
TINY += ["train.checkpoint_interval=0", "replay_capacity=64", "event_capacity=40"]  # small: saved at every step
STAGES = "stages=[{name: first, total_frames: 24}, {name: second, total_frames: 40, alpha: 0.2, env: {num_envs: 4}}]"


class Killed(BaseException):
    pass


def start(*arguments):
    return start_training(import_module("rare_targets").build, compose_config("rare_targets", list(arguments)))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The run of a training in two stages that nobody interrupted."""
    run = tmp_path_factory.mktemp("stages") / "whole"
    start(*TINY, STAGES, f"run_dir={run}").run()
    return run


def test_a_training_that_is_killed_in_its_stages_ends_like_an_uninterrupted_one(whole, tmp_path, monkeypatch):
    run = tmp_path / "killed"
    store = Trainer._store
    begin = [*TINY, STAGES, f"run_dir={run}"]
    for at in (("first", 16), ("second", 4), ("second", 24)):

        def die(train, data, at=at):
            if (train.describe()["config"]["stage"], train.frames) == at:
                raise Killed
            store(train, data)

        monkeypatch.setattr(Trainer, "_store", die)
        with pytest.raises(Killed):
            start(*begin).run()
        begin = [f"resume={run}"]
    monkeypatch.setattr(Trainer, "_store", store)
    start(*begin).run()
    for stage in ("1_first", "2_second"):
        found = differences(run / "stages" / stage, whole / "stages" / stage)
        assert [name for name in found if name != "metrics/episodes"] == [], stage


def test_a_stage_starts_from_the_weights_of_the_one_before(tmp_path):
    tiny = [argument for argument in TINY if not argument.startswith("train.utd_ratio")]
    tiny += ["train.checkpoint_interval=300", "train.eval_interval=0", f"run_dir={tmp_path}"]
    curriculum = start(*tiny, STAGES.replace("alpha: 0.2", "alpha: 0.2, train: {utd_ratio: 0}"))
    curriculum.run()
    states = [read_state(find_checkpoint(tmp_path / "stages" / name)) for name in ("1_first", "2_second")]
    for part in ("actor", "critics"):
        for name, value in states[0][part].items():
            assert torch.equal(value, states[1][part][name]), name
    assert states[0]["learner"]["updates"] > states[1]["learner"]["updates"] == 0
    assert [state["loop"]["frames"] for state in states] == [24, 40]
    assert states[1]["config"]["loss"]["alpha_init"] == 0.2 and states[0]["config"]["loss"]["alpha_init"] == 0.01
    assert find_checkpoint(tmp_path).parents[1].name == "2_second"
    with pytest.raises(CheckpointError, match="holds a run already"):
        start(*TINY, STAGES, f"run_dir={tmp_path}")


def test_a_stage_that_is_started_alone_ends_like_the_one_of_the_whole_training(whole, tmp_path):
    first, second = whole / "stages" / "1_first", whole / "stages" / "2_second"
    start(*TINY, STAGES, "stage=second", f"init_from={first}", f"run_dir={tmp_path / 'alone'}").run()
    assert differences(tmp_path / "alone", second) == []


def test_a_signal_at_the_end_of_a_stage_ends_the_training(whole, tmp_path, monkeypatch):
    run, evaluate = tmp_path / "run", Trainer._evaluate

    def interrupted(train):
        if (train.describe()["config"]["stage"], train.frames) == ("first", 24):
            os.kill(os.getpid(), signal.SIGTERM)
        evaluate(train)

    monkeypatch.setattr(Trainer, "_evaluate", interrupted)
    start(*TINY, STAGES, f"run_dir={run}").run()
    assert [folder.name for folder in (run / "stages").iterdir()] == ["1_first"]
    elsewhere = tmp_path / "elsewhere"
    buffers = [*run.glob("stages/1_first/checkpoints/*/replay")]
    start(f"resume={run}", f"run_dir={elsewhere}").run()
    assert buffers and all(folder.is_dir() for folder in buffers)
    start(f"resume={run}").run()
    assert not any(folder.exists() for folder in buffers)
    for end in (run, elsewhere):
        assert differences(end / "stages" / "2_second", whole / "stages" / "2_second") in ([], ["metrics/episodes"])


def test_a_finished_stage_keeps_no_replay_buffer(whole):
    assert [folder.parents[2].name for folder in whole.glob("stages/*/checkpoints/*/replay")] == ["2_second"]


def test_a_later_stage_that_cannot_start_is_one_sentence(tmp_path):
    second = STAGES.replace("name: second", "name: second, mirror: 0.5")
    with pytest.raises(CheckpointError, match=r"^stage second cannot start, those before it are kept: mirror=0.5"):
        start(*TINY, second, f"run_dir={tmp_path}").run()


@pytest.mark.filterwarnings("ignore:.*was not written")
def test_a_stage_whose_end_is_not_saved_is_followed_by_none(tmp_path, monkeypatch):
    run, save = tmp_path / "run", CheckpointStore.save

    def fail(store, state, *arguments):
        if state["loop"]["frames"] >= 16:
            raise OSError(28, "No space left on device")
        return save(store, state, *arguments)

    monkeypatch.setattr(CheckpointStore, "save", fail)
    with pytest.raises(CheckpointError, match="the end of stage first was not saved"):
        start(*TINY, STAGES, f"run_dir={run}").run()
    monkeypatch.setattr(CheckpointStore, "save", save)
    start(f"resume={run}").run()
    assert (run / "stages" / "2_second" / "checkpoints" / "LATEST").exists()


def test_an_earlier_stage_is_not_repeated_into_a_later_one(whole):
    earlier = sorted((whole / "stages" / "1_first" / "checkpoints").glob("frames_*"))[-2]
    with pytest.raises(CheckpointError, match="2_second holds a run already"):
        start(f"resume={earlier}")


def test_a_stage_is_forgotten_before_the_next_one_is_built(tmp_path, monkeypatch):
    """Its replay buffer takes memory, and TorchRL raises the number of threads when its environments are closed."""

    class Stage:
        stopped = False

        def __init__(self):
            self.cycle = self

        def run(self):
            return {}

    remembered, built = weakref.WeakSet(), []

    def build(config):
        assert not remembered
        stage = Stage()
        remembered.add(stage)
        built.append(config["stage"])
        return stage

    monkeypatch.setattr("coachable.training.curriculum._is_finished", lambda *_: True)
    threads = {"simulator": 1, "learner": 1}
    stages = [{"stage": name, "threads": threads} for name in ("first", "second", "third")]
    Curriculum({"run_dir": str(tmp_path), "stages": stages, "init_from": None, "resume": None}, build).run()
    assert built == ["first", "second", "third"]


def test_all_stages_share_the_cores_that_were_free_at_the_start(tmp_path, monkeypatch):
    """Later the training itself keeps them busy."""
    monkeypatch.setattr("coachable.training.curriculum.share_threads", lambda **_: Threads(simulator=5, learner=3))
    stages = [{"stage": "first", "threads": {"simulator": None, "learner": None}}]
    stages += [{"stage": "second", "threads": {"simulator": None, "learner": 1}}]
    config = {"run_dir": str(tmp_path), "stages": stages, "init_from": None, "resume": None}
    shared = [stage["threads"] for stage in Curriculum(config, lambda config: None).stages]
    assert shared == [{"simulator": 5, "learner": 3}, {"simulator": 5, "learner": 1}]


def test_what_the_command_line_says_holds_in_all_stages():
    config = compose_config("rare_targets", [*TINY, STAGES, "alpha=0.3", "train.total_frames=8"])
    assert [stage["loss"]["alpha_init"] for stage in config["stages"]] == [0.3, 0.3]
    assert [stage["train"]["total_frames"] for stage in config["stages"]] == [8, 8]


def test_a_mapping_sets_its_entries_and_leaves_the_rest_to_the_stages():
    for arguments in (["train={batch_size: 9}"], ["train.batch_size=9"]):
        config = compose_config("rare_targets", [*TINY, STAGES, *arguments])
        assert [stage["train"]["batch_size"] for stage in config["stages"]] == [9, 9]
        assert [stage["train"]["total_frames"] for stage in config["stages"]] == [24, 40]


def test_what_the_command_line_refers_to_is_looked_up_in_each_stage():
    config = compose_config("rare_targets", [*TINY, STAGES, "critic_support.v_max=${alpha}"])
    assert [stage["critic_support"]["v_max"] for stage in config["stages"]] == [0.01, 0.2]


def test_what_the_command_line_removes_stays_away_in_all_stages():
    stages = "stages=[{name: first}, {name: second, env: {seconds: 9}}]"
    config = compose_config("cheetah_speed", ["preset=smoke", stages, "~env.seconds"])
    assert ["seconds" in stage["env"] for stage in config["stages"]] == [False, False]


def test_new_observations_of_a_stage_that_is_trained_on_its_own():
    clean = compose_config("racing_qr_sac", ["preset=resources", "stage=clean", "init_new_observations=33"])
    assert clean["init_new_observations"] == 33
    traffic = ["preset=resources", "stage=traffic"]
    assert compose_config("racing_qr_sac", traffic)["init_new_observations"] == 33
    assert compose_config("racing_qr_sac", [*traffic, "init_new_observations=0"])["init_new_observations"] == 0


def test_an_added_key_that_nothing_reads_is_refused_if_it_looks_like_a_setting():
    with pytest.raises(ValueError, match=r"^\+batch_size has no effect: expected train.batch_size$"):
        compose_config("rare_targets", [*TINY, "+batch_size=8"])


def test_a_later_stage_keeps_its_own_settings_beside_resume(whole, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    shutil.rmtree(run / "stages" / "2_second")
    config = compose_config("rare_targets", [f"resume={run}", "alpha=0.01", "train={log_interval: 5}"])
    assert [stage["alpha"] for stage in config["stages"]] == [0.01, 0.2]
    assert [stage["train"]["log_interval"] for stage in config["stages"]] == [5, 5]
    assert [stage["train"]["batch_size"] for stage in config["stages"]] == [12, 12]
    with pytest.raises(ValueError, match=r"^~env.num_envs cannot be removed from a resumed run"):
        compose_config("rare_targets", [f"resume={run}", "~env.num_envs"])


def test_a_group_that_is_removed_is_named():
    with pytest.raises(ValueError, match=r"^replay: Missing mandatory value"):
        compose_config("rare_targets", [*TINY, "~replay"])
    with pytest.raises(ValueError, match=r"^stage first: replay: Missing mandatory value"):
        compose_config("rare_targets", [*TINY, STAGES, "~replay"])


def test_one_stage_can_be_trained_on_its_own():
    config = compose_config("rare_targets", [*TINY, STAGES, "stage=second"])
    assert config["stages"] == [] and config["alpha"] == 0.2 and config["train"]["total_frames"] == 40
    with pytest.raises(ValueError, match=r"stage=third does not exist.* Valid: first, second"):
        compose_config("rare_targets", [*TINY, STAGES, "stage=third"])
    with pytest.raises(ValueError, match=r"stage=third does not exist"):
        compose_config("rare_targets", [*TINY, "stage=third"])


@pytest.mark.parametrize(
    "stages, message",
    [
        ("[{total_frames: 8}]", "a stage has no name"),
        ("[{name: a, alhpa: 0.1}]", "stage a changes alhpa"),
        ("[{name: a, train: {batchsize: 3}}]", "batchsize"),
        ("[{name: a, total_frames: 0}]", "train.total_frames=0: expected a whole number"),
        ("[{name: a, total_frames: 8, train: 7}]", "stage a: .*int is not a subclass of Loop"),
    ],
)
def test_mistakes_in_a_stage_are_named_at_the_start(stages, message):
    with pytest.raises(ValueError, match=message):
        compose_config("rare_targets", [*TINY, f"stages={stages}"])


@pytest.mark.parametrize("name", ["../../elsewhere", "/tmp/x", "", "..", None, 3])
def test_the_name_of_a_stage_leads_nowhere_else(name, tmp_path):
    config = {"run_dir": str(tmp_path), "stages": [{"stage": name}], "init_from": None, "resume": None}
    with pytest.raises(CheckpointError, match="a stage is called"):
        Curriculum(config, build=None)


@pytest.mark.parametrize(
    "harm, message",
    [
        ({"_target_": "builtins.print"}, r"names 'builtins.print' as its env.nested._target_: expected none"),
        ("${oc.env:HOME}", r"as its env.nested: expected a plain value"),
        (7, r"frames_0*40"),
    ],
)
def test_a_saved_stage_names_nothing_that_the_recipe_does_not(harm, message, whole, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    file = find_checkpoint(tmp_path / "run") / "state.pt"
    state = torch.load(file, weights_only=True)
    if harm == 7:
        state["config"]["stages"] = [7, 7]
    else:
        state["config"]["stages"][1]["env"]["nested"] = harm
    torch.save(state, file)
    with pytest.raises(CheckpointError, match=message):
        start(f"resume={tmp_path / 'run'}")
