"""Sections of runs whose every number is worked by hand."""

import math
import re
from functools import partial

import pytest

from flowrep.report.cell_text import listed, p_text, percent, points, ratio
from flowrep.report.runs import Condition, cell_of, changes, curve_of, paired_scores, read_runs
from flowrep.report.sections import Report, ReportSection, assemble, write_files
from flowrep.report.statistics import Estimate
from flowrep.report.tables import Table
from tests.report.folders import config_of, rows_of, run_in, write_run

NORMAL = Condition("greedy", "normal", 12.0)


def sections_of(folder):
    runs, warnings = read_runs([folder])
    report = assemble(runs, warnings)
    found = {section.folder: section for section in report.sections}
    return found, report


run_in = partial(run_in, scene="s_turn")


def rows_in(table):
    return [row for _, rows in table.blocks for row in rows]


def later(rows, episodes):
    return [row | {"episode_seed": row["episode_seed"] + episodes} for row in rows]


def test_a_cell_counts_all_episodes_of_its_runs_and_a_difference_those_that_both_sides_share(
    tmp_path,
):
    # Episodes 100 to 103, 102 to 105, and 101 to 103 of the other side: 102 and 103 are of all.
    first, second, other = config_of(), config_of(seed=1), config_of(stack="seg2")
    write_run(tmp_path / "a", first, rows_of(first, "cssc"))
    write_run(tmp_path / "b", second, later(rows_of(second, "ccsss"), 2))
    write_run(tmp_path / "c", other, later(rows_of(other, "csc"), 1))
    runs, _ = read_runs([tmp_path])
    flows, seg = ([r for r in runs if r.stack == stack] for stack in ("ego+obj", "seg2"))
    cell = cell_of(flows, NORMAL)
    assert (cell.rates.tolist(), cell.counts) == ([0.5, 0.6], "2 × 4–5")
    (ours, theirs), number = paired_scores([flows, seg], [NORMAL])
    assert (ours.tolist(), theirs.tolist(), number) == ([0.5, 0.0], [0.5], 2)
    assert paired_scores([flows, []], [NORMAL]) is None


def test_p_is_corrected_for_the_comparisons_of_its_block(tmp_path):
    # The same 4 against 1 and 2 of 8 in each of two speeds: twice the p value.
    for seed in range(2):
        ends = "s" * (6 + seed) + "c" * (2 - seed)
        run_in(tmp_path, f"a{seed}", {"low": ends, "high": ends}, stack="raw", seed=seed)
        ends = "s" * (1 + seed) + "c" * (7 - seed)
        run_in(tmp_path, f"b{seed}", {"low": ends, "high": ends}, stack="ego", seed=seed)
    low, high = rows_in(sections_of(tmp_path)[0]["flow_composition"].tables[1])
    assert low[4] == high[4] == "0.019"  # Welch: 0.625 / 0.0884 = 7.07, 2 degrees
    assert low[5] == high[5] == "0.039"
    assert low[2] == "+62 [+24, +100]"  # t = 4.303
    assert (low[3], low[6]) == ("lower" if low[0].startswith("ego") else "higher", "100")


def test_table_iii_leaves_time_outs_out_and_has_the_ratio(tmp_path):
    # Two seeds: 1 of 4 and 3 of 20 failures are out of bounds: 20 %, 80 %, 0.25. As 4 of 24
    # together, or with the time-outs, it would be less.
    run_in(tmp_path, "a", "occc" + "t" * 4 + "s")
    run_in(tmp_path, "b", "ooo" + "c" * 17 + "t" + "sss", seed=1)
    run_in(tmp_path, "c", "ssssssss", stack="seg2")
    run_in(tmp_path, "d", {"low": "cccc"}, stack="depth2")
    found, _ = sections_of(tmp_path)
    (table,) = found["failure_causes"].tables
    flows, depth, seg = rows_in(table)
    assert flows[0] == "ego+obj"
    assert [cell.split()[0] for cell in flows[1:]] == ["20.0", "80.0", "0.250", "24", "5", "33"]
    assert depth == ("depth2", "missing", "missing", "missing", "0", "0", "0")
    assert seg == ("seg2", "no failures", "no failures", "no failures", "0", "0", "8")


def test_table_iii_is_of_low_and_high_speed_together_where_both_were_driven(tmp_path):
    # out of bounds 1 of 2 at low, 1 of 4 at high: 2 of 6; at the training speed 3 of 3
    run_in(tmp_path, "a", {"low": "ocss", "normal": "ooo", "high": "occc"})
    (table,) = sections_of(tmp_path)[0]["failure_causes"].tables
    ((_, share, *_, failures, _, episodes),) = rows_in(table)
    assert (share.split()[0], failures, episodes) == ("33.3", "6", "8")
    assert "Low and high speed" in table.caption


def test_a_cell_without_runs_is_missing_and_so_are_means_that_need_it(tmp_path):
    run_in(tmp_path, "a", {"low": "sssc", "normal": "sscc", "high": "sccc"}, stack="ego")
    run_in(tmp_path, "b", {"low": "ssss", "normal": "ssss"}, stack="ego+obj")
    run_in(tmp_path, "c", {"low": "ssss"}, stack="raw", scene="straight_road")
    found, _ = sections_of(tmp_path)
    success, differences = found["flow_composition"].tables
    road, turn, everywhere = ({row[0]: row[1:] for row in rows} for _, rows in success.blocks)
    assert [cell.split()[0] for cell in turn["ego"]] == ["75", "50", "25", "1"]
    assert [cell.split()[0] for cell in turn["ego+obj"]] == ["100", "100", "missing", "1"]
    assert "obj" not in turn  # nobody asked for it
    assert turn["raw"] == ("missing", "missing", "missing", "0")
    assert road["raw"][0].split()[0] == "100"
    assert everywhere["ego"] == ("missing", "missing", "missing", "")
    told = {(row[0], row[1]): row for row in rows_in(differences)}
    assert sorted(told) == [("ego+obj − ego", "low"), ("ego+obj − ego", "normal")]
    assert told["ego+obj − ego", "normal"][2:4] == ("+50", "can't be tested")  # one run a side


def test_the_change_with_the_frame_rate_is_that_of_the_same_agents_and_episodes(tmp_path):
    # At 12 Hz 4 of 4, at 6 Hz 1 of 4: -75 points; a seed without 6 Hz is no part of it.
    config, other = config_of(), config_of(seed=1)
    rows = rows_of(config, "ssss") + rows_of(config, "sccc", fps=6.0)
    write_run(tmp_path / "a", config, rows)
    write_run(tmp_path / "b", other, rows_of(other, "cccc") + rows_of(other, "ss", fps=9.0))
    found, _ = sections_of(tmp_path)
    (table,) = found["frame_rate"].tables
    assert table.header[1:] == ("6 Hz (%)", "9 Hz (%)", "12 Hz (%)", "12 → 6 Hz (points)")
    ((_, at_6, _, at_12, lost),) = rows_in(table)
    assert at_6.startswith("25 [")
    assert at_12.startswith("50 [")
    assert lost == "−75"


def test_runs_that_each_drove_at_one_frame_rate_show_no_change_with_it(tmp_path):
    for seed, fps in enumerate((12.0, 6.0)):
        config = config_of(seed=seed)
        write_run(tmp_path / f"{seed}", config, rows_of(config, "sscc", fps=fps))
    assert "frame_rate" not in sections_of(tmp_path)[0]


def test_a_run_that_drove_other_episodes_in_each_condition_is_no_part_of_a_change(tmp_path):
    # Seed 0 loses both of its episodes; seed 1 drove others at low speed. As a change of 0 it
    # would halve the loss.
    run_in(tmp_path, "a", {"low": "ss", "normal": "cc"})
    config = config_of("s_turn", seed=1)
    rows = later(rows_of(config, "ss", speed="low"), 50) + rows_of(config, "ss")
    write_run(tmp_path / "b", config, rows)
    runs, _ = read_runs([tmp_path])
    low = Condition("greedy", "low", 12.0)
    assert changes(runs, low, NORMAL).tolist() == [-1]
    assert changes(runs[1:], low, NORMAL).tolist() == []


def test_a_baseline_stands_beside_the_runs_of_its_config_alone(tmp_path):
    # Never turning succeeds in 3 of 4 and, with less time, in 1 of 4; both as one would be 1 of 4.
    for name, reached, other in (("a", "sssc", {}), ("b", "sccc", {"scene__time_limit_steps": 90})):
        config = config_of("s_turn", **other)
        rows = rows_of(config, "ssss") + rows_of(config, reached, policy="never_turn")
        write_run(tmp_path / name, config, rows)
    found, _ = sections_of(tmp_path)
    for name, share, limit in (("1_success", "75", 250), ("2_success", "25", 90)):
        assert found[name].label == f"scene.s_turn.time_limit_steps={limit}"
        assert rows_in(found[name].tables[0])[1][:2] == ("never turn", share)


def test_pairs_that_are_too_many_for_a_table_are_counted(tmp_path):
    for place in range(7):  # 7 · 6 / 2 = 21 pairs
        run_in(tmp_path, f"{place}", "sc", stack=f"map{place}")
    differences = sections_of(tmp_path)[0]["success"].tables[1]
    assert len(rows_in(differences)) == 15
    assert {"15", "21"} <= set(differences.caption.split())


def test_runs_of_none_of_the_papers_experiments_are_shown_all_the_same(tmp_path):
    run_in(tmp_path, "a", "sscc", stack="rgb", scene="my_crossing")
    found, _ = sections_of(tmp_path)
    assert list(found) == ["success", "failure_causes"]
    ((stack, share, counts),) = rows_in(found["success"].tables[0])
    assert (stack, share.split()[0], counts) == ("rgb", "50", "1 × 4")


def test_an_unfinished_run_is_in_the_learning_curve_alone(tmp_path):
    config = config_of()
    rows = rows_of(config, "sc", evaluation="training", frames=400)
    write_run(tmp_path / "half", config, rows, [{"frames": 400, "success": 0.25}])
    found, report = sections_of(tmp_path)
    assert list(found) == ["learning_curves"]
    (warning,) = report.warnings
    assert all(part in warning for part in ("half", "400", "1,000"))


def test_a_run_without_greedy_episodes_says_which_report_has_its_sampled_ones(tmp_path):
    config = config_of()
    rows = rows_of(config, "sc", policy="sampled") + rows_of(config, "cc", policy="random")
    write_run(tmp_path / "drawn", config, rows)
    (warning,) = sections_of(tmp_path)[1].warnings
    assert re.findall(r"policy=(\w+)", warning) == ["greedy", "sampled"]


def test_a_learning_curve_is_of_the_speed_and_frame_rate_of_training(tmp_path):
    config = config_of()
    rows = rows_of(config, "sscc", evaluation="training", frames=500)
    rows += rows_of(config, "sssc", evaluation="final")
    rows += rows_of(config, "cccc", evaluation="final", fps=6.0)
    rows += rows_of(config, "cccc", evaluation="final", speed="high")
    rows += rows_of(config, "cccc", evaluation="evaluate")
    rows += rows_of(config, "cccc", evaluation="training", frames=1000)  # other episodes
    write_run(tmp_path / "run", config, rows, [{"frames": 500, "success": 0.1}])
    curve = curve_of(read_runs([tmp_path])[0][0])
    assert curve == ([(500, 0.5), (1000, 0.75)], [(500, 0.1)])


def test_numbers_are_printed_with_their_intervals():
    assert percent(Estimate(0.854, 0.791, 0.901)) == "85 [79–90]"
    assert points(Estimate(0.123, -0.031, 0.2)) == "+12 [−3, +20]"
    assert points(Estimate(0.25, -2.93, 3.43)) == "+25 [too few runs]"
    assert percent(Estimate(0.854, math.nan, math.nan)) == "85"
    assert points(Estimate(-0.123, math.nan, math.nan)) == "−12"
    assert ratio(Estimate(0.2, 0.1, 1.0)) == "0.250 [0.111–∞]"
    assert [p_text(p) for p in (0.0449, 0.0001, math.nan)] == ["0.045", "<0.001", ""]
    assert (listed(["a", "b", "c"]), listed(["a"])) == ("a, b and c", "a")


def test_a_table_is_csv_with_its_headings_in_the_first_column():
    blocks = (("S-Turn", (("a_b", "85 [79–90]"),)), ("", (("c", "−3"),)))
    table = Table("t", "In %, 5 × 2.", ("what", "value (%)"), blocks)
    assert table.to_csv() == ("group,what,value (%)\nS-Turn,a_b,85 [79–90]\n,c,−3\n")


def test_files_of_an_earlier_report_are_removed_and_no_others(tmp_path):
    def write(*folders):
        tables = (Table("success", "", ("stack",), ()),)
        sections = (ReportSection("success", "", tables, folder=name) for name in folders)
        write_files(Report((), (), tuple(sections)), out)

    out, mine = tmp_path / "out", tmp_path / "mine" / "success.csv"
    for path in (mine, out / "1_success" / "notes.csv"):
        path.parent.mkdir(parents=True)
        path.write_text("")
    write("1_success", "2_success")
    with (out / "files.txt").open("a") as file:
        file.write(f"../mine/success.csv\n{mine}\n")
    write("success")
    left = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert left == {"files.txt", "success/success.csv", "1_success/notes.csv"}
    assert not (out / "2_success").exists()
    (out / "success").rename(tmp_path / "moved")
    (out / "success").symlink_to(mine.parent)
    for name in ("1_success", "success"):  # where files are removed, and where they are written
        with pytest.raises(OSError, match="link"):
            write(name)
    assert mine.is_file()
