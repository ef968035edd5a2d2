"""Learning curves from the metrics that runs leave behind."""

import numpy as np
import pytest

from coachable.cli import main
from coachable.evaluation.curves import draw_learning_curves, read_metric, summarise_runs


def make_run(folder, slope, rows=20):
    folder.mkdir(parents=True)
    lines = ["updates,episode/return,empty"] + [f"{i},{slope * i},," for i in range(rows)]
    (folder / "metrics.csv").write_text("\n".join(line.removesuffix(",") for line in lines) + "\n")
    return folder


def test_mean_and_interval_over_runs(tmp_path):
    runs = [make_run(tmp_path / f"seed{slope}", slope) for slope in (1.0, 2.0, 3.0)]
    at, mean, (low, high) = summarise_runs(runs, "updates", "episode/return", smooth=1)
    np.testing.assert_allclose(mean, 2.0 * at)
    assert at[0] == 0
    assert at[-1] == 19
    assert (low[1:] < mean[1:]).all()
    assert (high[1:] > mean[1:]).all()
    np.testing.assert_allclose([low[-1], high[-1]], [19.0, 57.0])  # all three the smallest, all three the largest


def test_smoothing_is_a_trailing_mean(tmp_path):
    at, mean, _ = summarise_runs([make_run(tmp_path / "run", 1.0)], "updates", "episode/return", smooth=5)
    assert at[0] == 4
    np.testing.assert_allclose(mean, at - 2)


def test_the_common_part_of_unequal_runs_is_drawn(tmp_path):
    runs = [make_run(tmp_path / "a", 1.0, rows=10), make_run(tmp_path / "b", 1.0, rows=20)]
    last = draw_learning_curves({"both": runs}, tmp_path / "curves.png", smooth=1)
    assert last == {"both": pytest.approx(9.0)}
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_runs_without_a_common_part_are_refused(tmp_path):
    runs = [make_run(tmp_path / "a", 1.0, rows=10), tmp_path / "b"]
    runs[1].mkdir()
    rows = (runs[0] / "metrics.csv").read_text().splitlines()
    (runs[1] / "metrics.csv").write_text("\n".join([rows[0], *(f"9{row}" for row in rows[1:])]))
    with pytest.raises(ValueError, match="in common: expected runs that overlap"):
        draw_learning_curves({"both": runs}, tmp_path / "curves.png", smooth=1)


def test_a_column_that_falls_is_no_horizontal_axis(tmp_path):
    (tmp_path / "metrics.csv").write_text("alpha,loss\n0.3,1\n0.2,2\n0.1,3\n")
    with pytest.raises(ValueError, match="has values of 'alpha' that fall: choose another x"):
        draw_learning_curves({"one": [tmp_path]}, tmp_path / "curves.png", x="alpha", y="loss")


def test_stages_follow_one_another(tmp_path):
    for number, slope in ((10, 3.0), (9, 2.0)):
        make_run(tmp_path / "run" / "stages" / f"{number}_name", slope, rows=3)
    at, values = read_metric(tmp_path / "run", "updates", "episode/return")
    np.testing.assert_allclose(at, [0, 1, 2, 2, 3, 4])
    np.testing.assert_allclose(values, [0, 2, 4, 0, 3, 6])


def test_unknown_and_empty_metrics_are_named(tmp_path):
    run = make_run(tmp_path / "run", 1.0)
    with pytest.raises(ValueError, match=r"no metric 'loss': expected one of \['updates', 'episode/return', 'empty'\]"):
        read_metric(run, "updates", "loss")
    with pytest.raises(ValueError, match="no row with both"):
        read_metric(run, "updates", "empty")


def test_the_command(tmp_path, capsys):
    make_run(tmp_path / "bf16_0", 1.0)
    assert main(["curves", f"bf16={tmp_path}/bf16_*", "--out", str(tmp_path / "c.png"), "--smooth", "1"]) == 0
    assert "bf16: episode/return 19 at the end" in capsys.readouterr().out
    make_run(tmp_path / "staged" / "stages" / "1_walk", 2.0)
    assert main(["curves", f"staged={tmp_path}/staged", "--out", str(tmp_path / "c.png"), "--smooth", "1"]) == 0
    assert "staged: episode/return 38 at the end" in capsys.readouterr().out
    make_run(tmp_path / "bf16_late" / "1", 2.0)
    both = [f"bf16={tmp_path}/bf16_0", f"bf16={tmp_path}/bf16_late/1"]
    assert main(["curves", *both, "--out", str(tmp_path / "c.png"), "--smooth", "1"]) == 0
    assert "bf16: episode/return 28.5 at the end" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["curves", f"fp32={tmp_path}/fp32_*"])
    assert "no run with a metrics.csv matches" in capsys.readouterr().err


def test_a_stage_begins_where_the_one_before_ended_also_if_its_last_rows_lack_the_metric(tmp_path):
    for stage, rows in (("0_walk", "100,\n200,1\n300,"), ("1_run", "100,2\n200,3")):
        (tmp_path / "stages" / stage).mkdir(parents=True)
        (tmp_path / "stages" / stage / "metrics.csv").write_text(f"frames,episode/return\n{rows}\n")
    at, values = read_metric(tmp_path, "frames", "episode/return")
    assert at.tolist() == [200.0, 400.0, 500.0]
    assert values.tolist() == [1.0, 2.0, 3.0]


def test_rows_without_a_number_are_left_out(tmp_path):
    (tmp_path / "metrics.csv").write_text("frames,eval/step_length\n100,0.4\n200,nan\n300,0.5\n400,nan\n")
    at, values = read_metric(tmp_path, "frames", "eval/step_length")
    assert at.tolist() == [100.0, 300.0] and values.tolist() == [0.4, 0.5]


def test_a_figure_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    def fill_disk(figure, path, **options):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    runs, out = [make_run(tmp_path / "run", 1.0)], tmp_path / "curves.png"
    out.write_bytes(b"old")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fill_disk)
    with pytest.raises(OSError, match="No space left"):
        draw_learning_curves({"one": runs}, out)
    assert out.read_bytes() == b"old" and {file.name for file in tmp_path.iterdir()} == {"curves.png", "run"}


def test_a_stage_without_the_metric_yet_leaves_the_curve_of_the_others(tmp_path):
    make_run(tmp_path / "run" / "stages" / "1_walk", 1.0)
    table = make_run(tmp_path / "run" / "stages" / "2_run", 1.0) / "metrics.csv"
    table.write_text("updates,loss/alpha\n0,0.1\n")
    at, values = read_metric(tmp_path / "run", "updates", "episode/return")
    np.testing.assert_allclose(values, at)
    assert len(at) == 20
