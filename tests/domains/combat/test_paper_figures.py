"""The paper's figures: what is counted in a grid of fights, and that every file is written."""

from argparse import Namespace
from dataclasses import replace

import apex_fight
import combat_ablations
import combat_modes
import matplotlib.image
import numpy as np
import paper_figures
import paper_tables
import pytest
import torch
from combat_bots import Bot
from element_use import element_rows
from fight_queue import fight_grid, run_fights
from paper_tables import KINDS
from reference_tables import head_rows, reference_tables
from request_odds import odds_rows, probability_of_pair

from coachable.domain import load_domain
from coachable.domains.combat.coached_fight import SOURCES, STATES
from coachable.domains.combat.fights import PARTS
from coachable.domains.combat.styles import combat_style_space
from coachable.envs.combat.tables import MACHINES
from coachable.training.weights import LoadedPolicy

STYLES = ["melee", "skykiller", "part_shield", "frost"]


@pytest.fixture(scope="module")
def domain():
    settings = {"styles": STYLES, "machines": ["Burrower"], "observation": "small", "traps": 0, "episode_steps": 60}
    return load_domain("combat", {"env": settings})


class Scripted:
    """Plays a bot whatever is asked; it reads the state of the environment that was made last."""

    def __init__(self, bot):
        self.bot, self.env, self.generator = bot, None, torch.Generator().manual_seed(0)

    def __call__(self, tensordict):
        return tensordict.set("action", self.bot.act(self.env, self.generator))


def watched(domain, bot):
    """The domain and an agent in it that plays the bot."""
    actor = Scripted(bot)

    def make_env(**options):
        actor.env = domain.make_env(**options)
        return actor.env

    agent = LoadedPolicy(actor, domain.make_space(), {"env": {"machines": ["Burrower"]}}, {"updates": 5})
    return replace(domain, make_env=make_env), agent


def test_more_fights_than_rows_are_all_fought_to_their_end(domain):
    domain, agent = watched(domain, Bot("spear"))
    theta = agent.space.make(melee=1.1).repeat(11, 1)
    machines = [("Burrower",), ("Scrounger",)] * 5 + [("Burrower",)]
    found = run_fights(domain, agent, theta, machines, ["Arena"] * 11, seed=0, batch=4)
    ended = found["won"] + np.maximum(found["died"], found["out_of_bounds"]) + found["timeout"]
    assert ended.tolist() == [1.0] * 11
    health = np.array([MACHINES[name].hp for (name,) in machines])
    won = found["won"] > 0
    assert won.sum() >= 6
    np.testing.assert_allclose(found["damage"][won], health[won], rtol=1e-4)  # each fight has its own machine
    assert (found["seconds"] <= 60 * 0.2 + 1e-6).all() and (found["seconds"] > 0).all()
    np.testing.assert_allclose(sum(found[name] for name in SOURCES), found["damage"], rtol=1e-4)
    alone = run_fights(domain, agent, theta[:3], machines[:3], ["Arena"] * 3, seed=0, batch=1)
    assert (alone["seconds"] > 0).all() and (alone["damage"] > 0).all()  # also where no other fight goes on meanwhile


def test_damage_in_a_state_is_divided_among_the_sources(domain):
    domain, agent = watched(domain, Bot("frost", "Advanced Frost Hunter Arrow"))
    found = run_fights(domain, agent, agent.space.default.repeat(3, 1), [("Longleg",)] * 3, ["Arena"] * 3, seed=0)
    assert found["by_state"].shape == (3, 8, 7)
    for number, state in enumerate(STATES):
        np.testing.assert_allclose(found["by_state"][:, :, number].sum(-1), found[state], rtol=1e-4, atol=1e-3)
    assert found["frost"].sum() > 0
    assert found["by_state"][:, SOURCES.index("sunscourge"), 2].sum() == pytest.approx(found["frost"].sum(), rel=1e-3)


def test_use_of_ammunition_and_states(domain):
    domain, agent = watched(domain, Bot("frost", "Advanced Frost Hunter Arrow"))
    [row] = element_rows(domain, agent, ["Longleg"], fights=2, seconds=30.0, seed=0)
    assert row["requested"] == "frost" and row["ammunition_otherwise"] is None
    assert 0.85 < row["ammunition"] <= 1.0  # from the second step of a fight on
    assert 0.2 < row["state"] < 0.9 and 0.2 < row["share"] < 1.0
    assert row["state"] < row["begins"] * 12.0 / 60.0  # a state lasts 12 s, or until the end of the fight
    assert row["damage_per_second"] > 0 and row["selection_per_second"] > 0 and row["build_up_per_second"] > 0
    without = LoadedPolicy(agent.actor, combat_style_space(["melee"]), agent.config, {})
    assert element_rows(domain, without, ["Longleg"], fights=1, seconds=1.0, seed=0) == []


def test_a_grid_has_every_style_opponent_and_site(domain):
    domain, agent = watched(domain, Bot("spear"))
    cells = [{name: 0.0 for name in STYLES}, {"melee": 1.1, "skykiller": 0.0, "part_shield": 0.0, "frost": 0.0}]
    found = fight_grid(domain, agent, cells, [("Burrower",), ("Scrounger",)], fights=1, seed=0)
    assert found["won"].shape == (2, 2, 3) and found["by_state"].shape == (2, 2, 3, 8, 7)
    assert np.isnan(found["requested"][0]).all()  # nothing is asked for
    np.testing.assert_allclose(found["requested"][1], found["melee"][1])
    with pytest.raises(ValueError, match="0 styles, 0 opponents and 0 sites"):
        run_fights(domain, agent, agent.space.default.repeat(0, 1), [], [], seed=0)


LABELS = ["default", "melee", "icestorm_boltblaster", "frost", "part_shield", "corrosive_blastsling + acid"]


def grids(**damage):
    """One seed with 5 fights against each of two opponents, and the given damage by kind and request."""
    shape = (len(LABELS), 2, 5)
    found = {name: np.zeros(shape) for name in (*KINDS, *PARTS, "won", "died", "out_of_bounds", "timeout")}
    for kind, values in damage.items():
        found[kind] += np.array(values, dtype=float)[:, None, None]
    found["damage"] = np.full(shape, 100.0)
    found["by_state"] = np.zeros((*shape, 8, 7))
    return found


def test_what_is_there_anyway_does_not_count_as_obeying():
    grid = grids(frost=[40, 0, 90, 60, 0, 0], melee=[10, 80, 0, 0, 0, 99])
    rows = {row["requested"]: row for row in paper_tables.obedience_rows([grid], LABELS)}
    # Icestorm has frost bolts and nothing without an element: its 90 HP do not count against the request for frost.
    assert (
        rows["frost"]["over_requests"] == pytest.approx(60 / 40) and rows["frost"]["over_requests_largest"] == "default"
    )
    assert rows["melee"]["over_requests"] == pytest.approx(8.0)  # composed requests are not single ones
    assert rows["melee"]["over_requests_low"] == rows["melee"]["over_requests_high"] == pytest.approx(8.0)
    implied = paper_tables.implied_kinds()
    assert implied["icestorm_boltblaster"] == {"frost", "plasma", "shock"}
    assert implied["plasma"] == {"icestorm_boltblaster"} and not implied["carjas_bane"]


def test_intervals_over_seeds_draw_the_same_seeds_under_every_request():
    # One agent removes three units whatever is asked, the other none.
    seeds = [grids(part_shield=[units] * 6, melee=[units] * 6) for units in (3, 0)]
    (parts,) = paper_tables.part_rows(seeds, LABELS)
    assert (parts["others"], parts["others_low"], parts["others_high"]) == (1.5, 0.0, 3.0)
    assert parts["ratio_high"] == pytest.approx(1.0)
    (melee, *_) = paper_tables.obedience_rows(seeds, LABELS)
    assert melee["over_requests_high"] == pytest.approx(1.0)


def test_rows_of_the_tables(tmp_path):
    grid = grids(frost=[40, 0, 90, 60, 0, 0], part_shield=[1, 1, 1, 1, 3, 9])
    grid["won"][:, 0] = 1.0
    grid["died"][:, 1] = 1.0
    grid["by_state"][3, :, :, SOURCES.index("sunscourge"), STATES.index("frost")] = 60.0
    matrix = paper_tables.matrix_rows([grid, grid], LABELS)
    cell = next(row for row in matrix if row["requested"] == "frost" and row["kind"] == "frost")
    assert (cell["damage"], cell["low"], cell["high"], cell["share"]) == pytest.approx((60, 60, 60, 0.6))
    (parts,) = paper_tables.part_rows([grid], LABELS)
    assert (parts["requested"], parts["others"], parts["ratio"]) == pytest.approx((3, 1, 3))
    machines = ["Burrower", "Sunwing"]
    first, second = paper_tables.record_rows([grid], LABELS, machines)
    assert (first["won"], first["died"], first["paper_won"], second["paper_won"]) == (25, 0, 1083, "")
    wins = paper_tables.win_rows([grid, grid], LABELS, machines)
    assert wins[0] == wins[0] | {"requested": "default", "opponent": "Burrower", "fights": 10, "won": 1.0}
    (radar,) = paper_tables.radar_rows([grid], LABELS, ["seed 0"])
    assert radar["sunscourge"] == radar["state_damage"] == 60.0
    pareto = [
        {"style": "melee", "weight": w, "style_score": w, "won": 1 - w / 2}
        | {f"{n}_{e}": v for n, v in (("style_score", w), ("won", 1 - w / 2)) for e in ("low", "high")}
        for w in (0.0, 0.5, 1.0)
    ]
    paper_figures.draw_matrix(matrix, tmp_path / "matrix.png")
    paper_figures.draw_wins(wins, tmp_path / "wins.png", 1)
    paper_figures.draw_radars([radar, radar | {"agent": "seed 1"}], tmp_path / "radars.png")
    paper_figures.draw_parts([parts], tmp_path / "parts.png")
    paper_figures.draw_pareto(pareto, tmp_path / "pareto.png")
    assert all(matplotlib.image.imread(path).std() > 0.05 for path in tmp_path.glob("*.png"))
    assert len(list(tmp_path.iterdir())) == 5


def test_two_kinds_of_damage_share_what_both_do(tmp_path):
    grid = grids(melee=[30, 0, 0, 0, 0, 0], frost=[10, 50, 0, 0, 0, 0])
    grid["won"][0] = 1.0
    rows = paper_tables.mixture_rows([grid, grid], [("melee", "frost", 0.9), ("melee", "frost", 0.1)])
    assert rows[0] == rows[0] | {"fights": 20, "share": 0.75, "share_low": 0.75, "both": 0.4, "won": 1.0}
    assert rows[1] == rows[1] | {"requested": 0.1, "share": 0.0, "both": 0.5, "won": 0.0}
    paper_figures.draw_mixtures(rows, tmp_path / "pairs.png")
    assert matplotlib.image.imread(tmp_path / "pairs.png").std() > 0.05


def test_a_fight_under_requests_in_turn_is_logged_and_drawn(domain):
    domain, agent = watched(domain, Bot("frost", "Advanced Frost Hunter Arrow"))
    names = apex_fight.requests_in_turn(agent.space.names)
    assert names == ("skykiller", "melee", "frost")
    renderer = domain.make_renderer(160, 120)
    log, frames = apex_fight.log_fights(domain, agent, names, fights=2, seed=0, draw=(renderer, 1))
    renderer.close()
    assert len(frames) == log.alive[:, 1].sum() and frames[0].shape == (164, 160, 3)
    expected = ((1.0 - log.machine[:-1]) * 3).astype(int).clip(max=2)
    assert (log.request[1:] == np.maximum.accumulate(expected)).all()
    lowest = [log.machine[log.alive[:, fight], fight].min() for fight in range(2)]
    assert log.best() == int(np.argmin(lowest))
    rows = log.timeline(0)
    assert len(rows) == log.alive[:, 0].sum() and rows[-1]["ended"] == "not won"
    with pytest.raises(ValueError, match="expected at least one of"):
        apex_fight.requests_in_turn(["part_shield"])


def test_a_berry_restores_no_more_than_is_missing():
    before, after = torch.tensor([400.0, 650.0, 650.0, 500.0]), torch.tensor([505.0, 700.0, 620.0, 450.0])
    taken = combat_modes.damage_taken(before, after, torch.tensor([1.0, 1.0, 1.0, 0.0]))
    assert taken.tolist() == [0.0, 0.0, 80.0, 50.0]


def test_ablations_of_a_preset_with_stages_are_refused(tmp_path):
    args = Namespace(threads=1, preset="full_cpu", frames=None, episodes=1)
    with pytest.raises(SystemExit, match="preset full_cpu has stages: expected one without"):
        combat_ablations.train("base", 0, tmp_path / "run", args)


def test_ablations_are_compared_at_equal_updates_and_at_equal_time(tmp_path):
    """The base takes 60 s per million env-steps, the other 30 s; half of the intervals were disturbed."""
    runs = {}
    for variant, slow, score in (("base", 60.0, 0.8), ("impersonation_0", 30.0, 0.4)):
        folder = tmp_path / f"{variant}_0"
        folder.mkdir()
        with (folder / "metrics.csv").open("w") as file:
            print("frames,updates,seconds/collect,seconds/store,seconds/update,eval/style_score,eval/won", file=file)
            seconds = 0.0
            for row in range(21):
                print(f"{row * 1e5},{row},{seconds / 4},{seconds / 4},{seconds / 2},{row * score / 20},1", file=file)
                seconds += slow * 0.1 * (1 + row % 2)
        runs[variant] = [folder]
    base, other = combat_ablations.final_rows(runs)
    assert (base["minutes"], other["minutes"]) == pytest.approx((2.0, 1.0), rel=1e-3)
    assert base["style_score"] == pytest.approx(0.8) and base["style_score_at_equal_time"] == pytest.approx(0.4)
    assert other["style_score"] == other["style_score_at_equal_time"] == pytest.approx(0.4)
    combat_ablations.draw(runs, tmp_path / "minutes.png", {"base": 1.0, "impersonation_0": 0.5})
    assert (tmp_path / "minutes.png").stat().st_size > 1000


def test_brittle_phases_are_counted_by_hand():
    steps, sun, sky = 8, SOURCES.index("sunscourge"), SOURCES.index("skykiller")
    row = {name: torch.zeros(1) for name in ("request", "counted", "player", "machine")}
    rows = [
        row
        | {"damage": torch.zeros(1, 8), "in_frost": torch.zeros(1, 8), "brittle": torch.tensor([step in (1, 2, 5)])}
        | {"chilled": torch.tensor([step in (0, 1, 4, 5)]), "alive": torch.tensor([True]), "won": torch.tensor([False])}
        for step in range(steps)
    ]
    for step in (0, 1, 4, 5):
        rows[step]["damage"][0, sun] = 10.0
    rows[2]["in_frost"][0, sky] = 100.0  # the first phase is used by the Skykiller, the second by the Sunscourge
    rows[5]["in_frost"][0, sun] = 10.0
    begun, everything = apex_fight.brittle_rows(apex_fight.FightLog(["frost"], 0.2, rows))
    assert begun["begun_by"] == "sunscourge" and everything["begun_by"] == "all"
    assert begun["phases"] == everything["phases"] == 2 and begun["switched"] == 0.5
    assert begun["skykiller"] == pytest.approx(100 / 110)


def test_odds_of_composed_requests_equal_the_count():
    space = load_domain("combat", {"env": {"styles": STYLES}}).make_space()
    pair = ("melee", "frost")
    rows = odds_rows(space, [pair], draws=200_000)
    # A tenth of the styles has all weights; two of 0.5/1.05 and one each of 0.35/1.05 (shields) and 0.6/2 (Skykiller).
    assert probability_of_pair(space, pair, 0.3) == pytest.approx(0.1 * (0.5 / 1.05) ** 2 * (0.35 / 1.05) * 0.3)
    for row in rows:
        assert row["counted"] == pytest.approx(200_000 * row["probability"], rel=0.15)
    full = load_domain("combat", {"env": {}}).make_space()
    assert probability_of_pair(full, ("corrosive_blastsling", "acid"), 0.3) < 1e-6  # as in the paper


def test_reference_tables_name_origins_and_heads_are_the_papers():
    tables = reference_tables()
    assert len(tables["table_machines"]) == 19 and "hp (paper)" in tables["table_machines"][0]
    assert {"paper_weight (paper)", "sim_weight (ours)"} <= set(tables["table_style_rewards"][0])
    assert all(row["outputs"] == row["outputs (paper)"] for row in head_rows())
