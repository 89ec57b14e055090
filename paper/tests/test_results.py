"""The page of results: verdicts worked by hand, and a page that says what the stored runs say."""

import re
import shlex
from dataclasses import replace
from datetime import UTC, datetime
from itertools import product

import numpy as np
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

pytest.importorskip("scipy", reason="reports are an extra")
pytest.importorskip("jinja2", reason="reports are an extra")


from flowrep.report.runs import Run, episode_columns, groups_of, without_repeats
from flowrep.report.statistics import Effect
from paper import claims, results
from paper.archive import read_archives
from tests.config.composing import plain
from tests.report.folders import config_of, letters, rows_of

DECLARED = yaml.safe_load(results.CLAIMS.read_text(encoding="utf-8"))
SCENES = {"straight_road": "sr_*", "s_turn": "st_*"}
NOTHING = episode_columns({})


def run_of(name, ends, *, scene="straight_road", stack="ego+obj", seed=0, paths=1):
    """A run whose episodes end as the letters say, by speed mode or frame rate."""
    config = config_of(scene, stack, seed, scene__paths=[{"name": str(k)} for k in range(paths)])
    rows = []
    for condition, outcomes in ends.items():
        where = {"speed": condition} if isinstance(condition, str) else {"fps": float(condition)}
        rows += rows_of(config, outcomes, **where)
    for row in rows:  # two paths: those of even and of odd seeds
        row["path"] = str(row["episode_seed"] % paths)
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    return Run(name, config, episode_columns(columns), {})


def claim_of(*contrasts):
    return {"claim": "c", "contrasts": contrasts, "limits": ""}


def declared_with(*contrasts, **changes):
    """What claims.yaml declares: a primary claim of these contrasts unless the changes differ."""
    base = {"studies": {"main": SCENES}, "scenes": [*SCENES], "secondary": []}
    return base | {"primary": [claim_of(*contrasts)]} | changes


def judged(runs, *contrasts, **changes):
    """The primary and secondary claims."""
    declared = declared_with(*contrasts, **changes)
    return claims.claims_of(declared, claims.studies_of(declared, runs))


def runs_with(**successes):
    """Runs of [ego,obj] and [raw] in two scenes with these successes of 8 at high speed."""
    found = []
    for prefix, scene in (("sr", "straight_road"), ("st", "s_turn")):
        for stack, numbers in successes.items():
            for seed, number in enumerate(numbers):
                ends = {"high": letters(number)}
                name = f"{prefix}_{stack}_{seed}"
                stack_name = {"both": "ego+obj"}.get(stack, stack)
                found.append(run_of(name, ends, scene=scene, stack=stack_name, seed=seed))
    return found


HIGH = {"first": "ego+obj", "second": "raw", "success": {"high": 1}, "expect": "more"}
EQUAL = HIGH | {"expect": "equal", "margin": 0.05}


def test_a_studys_runs_have_names_like_any_of_its_patterns():
    names = ("road_raw_s12", "road_raw_s13", "road_all_s12", "turn_raw_s13")
    runs = [run_of(name, {"high": letters(8)}) for name in names]
    declared = {"studies": {"main": {"straight_road": "road_*_s13 road_all_*", "s_turn": "none_*"}}}
    found = claims.studies_of(declared, runs)
    names = {scene: [run.name for run in of] for scene, of in found["main"].items()}
    assert names == {"straight_road": ["road_raw_s13", "road_all_s12"]}


@pytest.mark.parametrize(
    ("expect", "both", "raw", "verdict"),
    [
        ("more", (6, 7), (2, 3), "holds"),  # +50, error 6.3 points
        ("less", (6, 7), (2, 3), "contradicted"),
        ("less", (2, 3), (6, 7), "holds"),
        ("more", (2, 8), (3, 4), claims.UNSEEN),
        ("more", (6,), (2, 3), "can't be tested"),
        ("more", (), (2, 3), "can't be tested"),
    ],
)
def test_a_contrast_is_judged_by_its_test_and_its_direction(expect, both, raw, verdict):
    asked = HIGH | {"expect": expect}
    (claim,), _ = judged(runs_with(both=both, raw=raw), asked)
    assert claim.verdict == verdict
    if verdict == "holds":
        assert abs(claim.contrasts[0].effect.value) == pytest.approx(0.5)


def test_a_scene_beside_the_others_is_shown_and_not_in_the_mean():
    runs = runs_with(both=(6, 7), raw=(2, 3))
    runs = [run for run in runs if not (run.scene == "s_turn" and run.stack == "raw")]
    all_well = {"high": letters(8)}
    runs += [run_of("st_raw", all_well, scene="s_turn", stack="raw", seed=s) for s in (0, 1)]
    (claim,), _ = judged(runs, HIGH, scenes=["straight_road"])
    (contrast,) = claim.contrasts
    assert contrast.effect.value == pytest.approx(0.5)
    assert contrast.by_scene["s_turn"].value == pytest.approx(-3 / 16)


@pytest.mark.parametrize(("asked", "p"), [(HIGH, "p_value"), (EQUAL, "p_against")])
def test_primary_contrasts_are_corrected_together_and_others_are_not(asked, p):
    runs, claim = runs_with(both=(6, 7), raw=(2, 3)), claim_of(asked)
    primary, (other,) = judged(runs, primary=[claim, claim], secondary=[claim])
    first, second, alone = (getattr(c.contrasts[0], p) for c in (*primary, other))
    assert 0 < alone < 0.05
    assert first == second == pytest.approx(2 * alone)


def equal_by(found):
    p_values = claims.p_within(found, 0.05), claims.p_beyond(found, 0.05)
    return claims.Contrast(EQUAL, found, {}, *p_values)


@pytest.mark.parametrize(
    ("value", "error", "verdict"),
    [
        (0.01, 0.01, "holds"),  # 90 % interval inside ±0.05
        (0.01, 0.05, claims.UNSEEN),
        (0.2, 0.01, "contradicted"),  # all of it beyond the margin
        (0.07, 0.02, claims.UNSEEN),
    ],
)
def test_alike_means_within_the_margin(value, error, verdict):
    assert equal_by(Effect(value, error, 10.0)).verdict == verdict


def test_equality_is_tested_against_the_nearer_end_of_the_margin_and_shown_as_suggested():
    # 0.01 within ±0.05: (0.01 - 0.05) / 0.02 = -2, of 10 degrees p = 0.0367, and as far on the
    # other side; 0.09 is as far beyond
    for value in (0.01, -0.01):
        assert claims.p_within(Effect(value, 0.02, 10.0), 0.05) == pytest.approx(0.0367, abs=1e-4)
        assert claims.p_beyond(Effect(value, 0.02, 10.0), 0.05) == 1
    assert claims.p_within(Effect(0.09, 0.02, 10.0), 0.05) == pytest.approx(1 - 0.0367, abs=1e-4)
    assert claims.p_beyond(Effect(-0.09, 0.02, 10.0), 0.05) == pytest.approx(2 * 0.0367, abs=2e-4)
    beyond, within = (results.effect_text(equal_by(Effect(x, 0.02, 10.0))) for x in (0.09, 0.01))
    assert beyond.split()[-4:] == ["=", "0.073", "(beyond", "±5)"]
    assert within.split()[-4:] == ["=", "0.037", "(within", "±5)"]


def test_exchanging_runs_tells_how_often_chance_alone_gives_as_much():
    # 3 of 6 runs succeed: 2 of the 20 ways to deal them to two sides are as unequal as this one,
    # and in two scenes alike, 2 of 400 are.
    sides = np.array([1, 1, 1]), np.array([0, 0, 0])
    assert claims.permuted_p([sides]) == pytest.approx(0.1, abs=0.01)
    assert claims.permuted_p([sides, sides]) == pytest.approx(0.005, abs=0.002)
    assert claims.permuted_p([(np.array([1, 0]), np.array([0, 1]))]) == 1.0


def test_a_claim_of_several_contrasts_may_hold_in_part():
    held = claims.Contrast(HIGH, Effect(0.5, 0.01, 5.0), {}, 0.001, 0.001)
    unseen, against = replace(held, p_value=0.5), replace(held, effect=Effect(-0.5, 0.01, 5.0))
    for contrasts, verdict in (
        ((held, unseen), "holds in part"),
        ((held, against), "holds in part"),
        ((unseen, against), "contradicted"),
        ((held, held), "holds"),
    ):
        assert claims.Claim(1, "", "", contrasts).verdict == verdict


@pytest.fixture(scope="module")
def packed():
    if not results.DATA.is_dir():
        pytest.skip("source distributions have no runs")
    return read_archives(results.DATA)


HELD_OUT = {
    "held_out": {
        "splits": {"fast": {"name": "A", "mode": "high"}, "slow": {"name": "B", "mode": "low"}},
        "claims": [
            {"claim": "c", "first": "ego+obj", "second": "raw"},
            {"claim": "d", "first": "raw", "second": "ego+obj"},
        ],
    }
}


def held_out_cells(successes, collapsed=()):
    """Two splits on Straight Road; in split B low speed is held out."""
    runs = {}
    for study, mode in (("fast", "high"), ("slow", "low")):
        runs[study] = {"straight_road": []}
        for stack, numbers in successes.items():
            for seed, number in enumerate(numbers):
                trained = 1 if (stack, seed) in collapsed else 6
                ends = {mode: letters(number), "normal": letters(trained)}
                run = run_of(f"{study}_{stack}_{seed}", ends, stack=stack, seed=seed)
                runs[study]["straight_road"].append(run)
    return claims.held_out_cells(HELD_OUT, runs)


def test_held_out_speeds_are_those_of_each_split_and_are_corrected_together():
    cells = held_out_cells({"ego+obj": (6, 7, 0), "raw": (2, 3, 1)}, {("ego+obj", 2)})
    first, second = claims.held_out_claims(HELD_OUT, cells)
    (contrast,) = first.claim.contrasts
    assert contrast.effect.value == pytest.approx(7 / 3 / 8)  # 13 of 24 against 6 of 24
    assert {*contrast.by_scene} == {"A SR", "B SR"}
    assert contrast.p_value == pytest.approx(2 * contrast.effect.p_value)
    assert first.collapsed == (2, 0)  # one run in each split
    assert first.without.effect.value == pytest.approx((6.5 - 2) / 8)
    assert second.claim.contrasts[0].effect.value == -contrast.effect.value
    assert "2 and 0" in results.held_out_table([first])


def test_beside_held_out_speeds_stand_those_of_training_and_what_is_lost_between():
    cells = held_out_cells({"ego+obj": (6, 7, 0), "raw": (2, 3, 1)}, {("ego+obj", 2)})
    first, second = claims.beside_held_out(HELD_OUT, cells)
    values = [each.effect and each.effect.value for each in first.values()]
    # Held out 13 of 24 against 6 of 24, in training 13 against 18; nobody drove the third mode.
    assert values == [*map(pytest.approx, (7 / 24, 7 / 24, -5 / 24, -12 / 24)), None]
    assert [*first][:2] == ["held out, A", "held out, B"]
    assert "|H2|−29 [" in results.beside_table([first, second])


def test_sensitivity_leaves_out_the_seed_and_the_panel_that_matter_most_and_pairs_seeds():
    cells = held_out_cells({"ego+obj": (6, 7, 2), "raw": (2, 3, 1)})
    seed, panel, paired, _ = claims.sensitivity(HIGH, cells).items()
    # without the seed of 2 and 1 of 8, 50 points with an error; without others, the spread stays
    assert seed[0] in ("0", "1")
    assert panel[0] in ("A SR", "B SR")
    # differences 4, 4 and 1 of 8 in both panels: mean 3/8, error 1/8, two degrees
    assert paired[1].effect == pytest.approx((3 / 8, 1 / 8, 2))


def test_contrasts_at_the_papers_length_are_paired_by_seed_and_corrected_by_family():
    length = {"study": "main", "scenes": ["straight_road"], "families": [[1, 2], [3]]}
    declared = declared_with(at_length=length, primary=[claim_of(HIGH)] * 3)

    def found_in(runs):
        return claims.at_length(declared, claims.studies_of(declared, runs))

    found = found_in(runs_with(both=(6, 7, 2, 8), raw=(2, 3, 1)))  # no run of [raw] has seed 3
    assert found[1].effect == pytest.approx((3 / 8, 1 / 8, 2))
    assert found[1].p_value == pytest.approx(2 * found[3].p_value)
    # two complete rounds decide nothing yet
    assert found_in(runs_with(both=(6, 8), raw=(2, 3))) == {}


def test_a_study_with_a_run_from_before_its_rules_is_refused_and_one_without_times_is_named():
    runs = runs_with(both=(6,))
    declared = declared_with(committed={"main": datetime(2026, 11, 29, 11, tzinfo=UTC)})
    for run in runs:
        run.machine = {"started": "2026-11-29T12:00:00+00:00"}
    assert claims.undated(declared, claims.studies_of(declared, runs)) == []
    runs[0].machine = {}
    assert claims.undated(declared, claims.studies_of(declared, runs)) == ["main"]
    runs[0].machine = {"started": "2026-11-29T10:00:00+00:00"}
    with pytest.raises(ValueError, match="main: sr_both_0"):
        claims.undated(declared, claims.studies_of(declared, runs))


def test_effects_without_some_runs_stand_beside_those_with_them():
    # [ego,obj] has 6, 7 and 0 of 8, and without the last 50 points more than [raw]
    runs = runs_with(both=(6, 7, 0), raw=(2, 3))
    left_out = [run for run in runs if run.stack == "ego+obj" and run.seed == 2]
    declared = declared_with(HIGH, secondary=[claim_of(HIGH), claim_of(HIGH | {"first": "raw"})])
    told = results.without(left_out, declared, claims.studies_of(declared, runs))
    assert [(text.split()[0], text.split()[-2:]) for text in told] == [
        ("+50", ["row", "1"]),
        ("+50", ["row", "2"]),  # the third compares [raw] with itself
    ]


def test_scores_are_of_the_episodes_that_all_drove():
    # episodes 100 to 103 and 100 to 101: 1 of 2 and 2 of 2
    sides = [[run_of("a", {"high": "scss"})], [run_of("b", {"high": "ss"})]]
    first, second = claims.scores(sides, {"success": {"high": 1}})
    assert (first.tolist(), second.tolist()) == ([0.5], [1.0])
    assert claims.scores([[run_of("c", {"low": "s"})]], {"success": {"high": 1}}) is None
    # so are frame rates: at 12 Hz four more episodes were driven, all failures
    table = results.rate_table([run_of("a", {12: "sssscccc", 6: "sscc"})])
    assert "|50|100|−50|0.50|1|" in table


def test_scores_weigh_conditions():
    run = run_of("a", {"low": "ssso", "high": "sccc", 12: "ssss", 6: "sscc"})
    asked = [
        ({"success": {"low": 1, "high": -1}}, 0.5),
        ({"success": {"low": 0.5, "high": 0.5}}, 0.5),
        ({"success": {12: 1, 6: -1}}, 0.5),
        ({"kept": [6, 12]}, 0.5),
        ({"out_of_bounds": ["low", "high"]}, 0.25),  # 1 of 4 failures
    ]
    for measure, value in asked:
        ((score,),) = claims.scores([[run]], measure)
        assert score == pytest.approx(value)


def test_a_run_finds_a_way_by_half_of_its_episodes():
    runs = [
        run_of("t_one", {"normal": "scscscsc"}, paths=2),
        run_of("t_all", {"normal": "ssssssss"}, paths=2),
        run_of("t_few", {"normal": "sssososc"}, seed=2, paths=2),  # the second way: s, o, o, c
        run_of("t_half", {"normal": "sscssscs"}, seed=3, paths=2),  # the first way: s, c, s, c
    ]
    assert results.missed_ways(runs) == [
        "`[ego,obj]` in SR (0: 0 %, pedestrian; 2: 25 %, out of bounds)"
    ]
    assert "2 of 4" in results.scene_table(runs, is_fork=True)
    assert results.all_ways_found(runs[1:]) == "2 of 3"


def test_pairs_of_runs_show_how_often_the_first_side_is_higher():
    # 6 and 2 against 2 and 3: of the four pairs two are higher and one is a tie
    (claim,), _ = judged(runs_with(both=(6, 2), raw=(2, 3)), HIGH)
    assert claim.contrasts[0].higher == pytest.approx(2.5 / 4)


def test_the_primary_contrasts_are_those_of_the_protocol():
    text = (results.PAGE.parent / "protocol.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \d+ \| .*$", text, re.MULTILINE)
    assert len(rows) == len(DECLARED["primary"])
    for row, claim in zip(rows, DECLARED["primary"]):
        (contrast,) = claim["contrasts"]
        for side in ("first", "second"):
            if side in contrast:
                assert f"[{contrast[side].replace('+', ',')}]" in row
        assert all(speed in row for speed in contrast["success"])


@pytest.mark.slow
def test_the_page_says_what_the_stored_runs_say(packed):
    text, figures = results.render(DECLARED, packed)
    assert text == results.PAGE.read_text(encoding="utf-8"), "run `make results`"
    assert {*figures} == {*re.findall(r"\]\((images/[^)]+)\)", text)}
    assert all((results.PAGE.parent / figure).is_file() for figure in figures)


@pytest.fixture(scope="module")
def stored(packed):
    return claims.studies_of(DECLARED, packed)


@pytest.mark.slow
def test_runs_of_one_study_and_scene_may_be_compared_and_drove_its_paths(stored):
    for study, of_scenes in stored.items():
        for scene, runs in of_scenes.items():
            assert len(groups_of(runs)) == 1, (study, scene)
            assert without_repeats(runs)[1] == [], (study, scene)
            for run in runs:
                names = {path["name"] for path in run.config["scene"]["paths"]}
                assert {*run.episodes["path"].tolist()} == names, run.name


def runs_of(command):
    """What identifies each run that a line of shell trains: scene, stack, seed, settings."""
    words = shlex.split(command)
    choices = {}
    for override in OverridesParser.create().parse_overrides(words[words.index("-m", 3) + 1 :]):
        is_list, key = override.is_sweep_override(), override.key_or_group
        values = override.sweep_string_iterator() if is_list else [override.input_line]
        choices[key] = [f"{key}={value}" if is_list else value for value in values]
    seeds = [int(text.partition("=")[2]) for text in choices.pop("seed")]
    stacks = [re.findall(r"\w+", text)[1:] for text in choices.pop("representations")]
    asked = [texts for key, texts in choices.items() if not key.startswith("hydra.")]
    for overrides in product(*asked):
        config = plain("train", "representations=[depth2,ego,obj,raw,seg2]", *overrides)
        for names in stacks:  # composing a config for each would take a quarter of a minute
            maps = {name: config["representations"][name] for name in names}
            run = Run("", config | {"representations": maps}, NOTHING, {})
            scene, stack, _, settings = identity(run)
            yield from ((scene, stack, seed, settings) for seed in seeds)


def identity(run):
    # a run stores what was asked for, "auto", and its machine what came of it
    settings = {k: v for k, v in run.settings.items() if k != "algorithm.precision"}
    return run.scene, run.stack, run.seed, tuple(sorted(settings.items()))


@pytest.mark.slow
@pytest.mark.parametrize("study", DECLARED["commands"])
def test_the_commands_of_a_study_make_its_stored_runs(stored, study):
    lines = DECLARED["commands"][study].replace("\\\n", "").splitlines()
    trained = [set(runs_of(line)) for line in lines if "flowrep.train" in line]
    assert set().union(*trained) == {identity(r) for of in stored[study].values() for r in of}


def test_students_are_compared_by_the_mean_of_three_speeds(tmp_path):
    (tmp_path / results.DISTILLED).write_text(
        "trained_at_mps,representations,seed,frames,episodes,low,normal,high\n"
        "0.6-2.4,raw,1,9,9,0.5,0.6,0.7\n"
        "0.6-2.4,ego+obj,1,9,9,0.8,0.85,0.9\n"
        "0.6-2.4,raw,2,9,9,0.4,0.5,0.6\n"
        "0.6-2.4,ego+obj,2,9,9,0.9,0.95,1.0\n"
    )
    rates = results.students(tmp_path)
    table = results.learned_table(rates).splitlines()
    # The means 0.6 and 0.5 have an error of 0.05; one degree of freedom, t = 12.7, gives no bound.
    assert table[2] == "|labels|0.6–2.4|`[raw]`|2|45|55|65|55 [0–100]|"
    # The errors 0.05 and 0.05 have two degrees of freedom, t = 4.30, and 0.35 is 4.95 errors:
    # p = 1 - t / sqrt(t² + 2).
    difference = results.learned_contrasts(rates).splitlines()[2:]
    assert difference == ["|labels|0.6–2.4|`[ego,obj]` − `[raw]`|+35 [+5, +65]|0.038|+40|+35|+30|"]
    assert results.spread(rates.values()) == pytest.approx(100 * 0.005**0.5)
