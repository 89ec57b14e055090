"""conf/experiment/: which runs each of them is, and what is evaluated at their ends."""

from collections import Counter

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra

pytest.importorskip("pybullet", reason="the schema reads the simulator's names")

from flowrep.config import UsageError
from flowrep.config.command_line import register_resolvers
from flowrep.config.composition import Preview, check_command
from flowrep.config.run_names import run_of_sweep
from flowrep.config.training import TrainConfig
from flowrep.config_tree import group_choices
from flowrep.train import final_episodes
from tests.config.composing import plain

SCENES = ["straight_road", "s_turn", "h_shaped_pathways", "three_way_junction"]
STACKS = [
    "[seg2]", "[depth2]", "[ego,obj]", "[ego,obj,seg2]", "[ego,obj,depth2]",
    "[ego,obj,seg2,depth2]",
]  # fmt: skip


def runs_of(*arguments):
    """The overrides of each run of a sweep, as mappings."""
    register_resolvers()
    preview = Preview(get_args_parser().parse_args(["-m", *arguments]), "train")
    parsed = preview.with_sweepers(preview.parse(arguments))
    GlobalHydra.instance().clear()
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    return [dict(override.split("=", 1) for override in job) for job in jobs]


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("name", "scenes", "stacks"),
    [
        ("flow_composition", SCENES, ["[ego]", "[raw]", "[obj]", "[ego,obj]"]),
        ("complementary", SCENES, STACKS),
        ("failure_causes", ["s_turn"], STACKS),
        ("frame_rate", ["straight_road"], STACKS),
    ],
)
def test_an_experiment_of_the_paper_has_each_stack_in_each_scene_with_three_seeds(
    name, scenes, stacks
):
    runs = runs_of(f"experiment={name}", "preset=laptop")
    cells = Counter((run["scene"], run["representations"]) for run in runs)
    assert cells == {(scene, stack): 3 for scene in scenes for stack in stacks}
    assert {run["seed"] for run in runs} == {"0", "1", "2"}
    assert {(run["experiment"], run["preset"]) for run in runs} == {(name, "laptop")}


def test_what_is_typed_replaces_what_the_experiment_sweeps():
    runs = runs_of("experiment=flow_composition", "scene=s_turn", "seed=7,8", "speed=high")
    assert len(runs) == 8
    assert {(run["scene"], run["speed"]) for run in runs} == {("s_turn", "high")}
    assert {run["seed"] for run in runs} == {"7", "8"}


@pytest.mark.parametrize("names", ["resolution,sensor_noise", "glob(f*)"])
def test_experiments_are_swept_one_at_a_time(names):
    with pytest.raises(UsageError, match=r"is several experiments, .* give each in a command of"):
        check_command("train", ["-m", f"experiment={names}"])


def test_experiments_without_runs_of_their_own_are_swept_together(tmp_path):
    (tmp_path / "experiment").mkdir()
    for speed in ("low", "high"):
        text = f"# @package _global_\nexperiment: people_{speed}\nspeed: {speed}\n"
        (tmp_path / "experiment" / f"people_{speed}.yaml").write_text(text)
    line = ["--config-dir", str(tmp_path), "-m", "experiment=people_low,people_high"]
    check_command("train", [*line, "scene=straight_road"])
    with pytest.raises(UsageError, match="is several experiments"):
        check_command("train", [*line[:-1], "experiment=people_low,resolution"])


def test_flow_is_estimated_in_half_of_the_runs_that_compare_it():
    flows = Counter(run["flow"] for run in runs_of("experiment=estimated_flow"))
    assert flows == {"exact": 6, "estimated": 6}


def test_each_stack_has_noise_in_half_of_the_runs_that_compare_it():
    runs = runs_of("experiment=sensor_noise", "preset=laptop")
    cells = Counter((run["noise"], run["representations"]) for run in runs)
    stacks = ["[ego,obj]", "[raw]", "[depth2]"]
    assert cells == {(noise, stack): 3 for noise in ("none", "depth_camera") for stack in stacks}
    assert {run["scene"] for run in runs} == {"straight_road"}
    names = {run_of_sweep(f"{key}={value}" for key, value in run.items()) for run in runs}
    assert len(names) == 18
    assert "sensor_noise_laptop_straight_road_ego+obj_s0_noise-depth_camera" in names


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", group_choices("experiment"))
def test_an_experiment_is_named_in_the_config_of_its_runs(name):
    assert plain("train", f"experiment={name}")["experiment"] == name
    assert plain("train")["experiment"] is None


def test_an_agent_is_evaluated_at_lower_frame_rates_than_it_was_trained_at():
    config = plain("train", "experiment=frame_rate", "preset=laptop")
    assert config["scene"]["frame_rate_hz"] == 12
    evaluation = config["evaluation"]
    assert evaluation["fps"] == [6, 7, 8, 9, 10, 12]
    assert evaluation["speeds"] == ["normal"]
    assert plain("train", "scene=s_turn")["evaluation"]["fps"] == [12]
    # greedy, sampled, never_turn, random
    assert final_episodes(config) == 6 * 1 * 4 * evaluation["final_episodes"]


@pytest.mark.slow_after_first
@pytest.mark.parametrize("height_px", [48, 84])
def test_pictures_stay_square_where_resolution_is_compared(height_px):
    sides = [f"scene.camera.height_px={height_px}", "preset=laptop", "scene=straight_road"]
    camera = plain("train", "experiment=resolution", *sides)["scene"]["camera"]
    assert (camera["height_px"], camera["width_px"]) == (height_px, height_px)
    assert camera["fov_deg"] == 60


@pytest.mark.slow
def test_a_mistake_in_an_experiment_of_one_s_own_is_named_before_any_run(tmp_path):
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\nhydra: {sweeper: {params: {scene: 's_turn,straight'}}}\n"
    (tmp_path / "experiment" / "mine.yaml").write_text(text)
    line = ["--config-dir", str(tmp_path), "experiment=mine"]
    check_command("train", line, TrainConfig)  # one run, nothing is swept
    with pytest.raises(UsageError, match="unknown scene 'straight'"):
        check_command("train", ["-m", *line], TrainConfig)
    check_command("train", ["-m", *line, "scene=s_turn"], TrainConfig)
