"""The baselines' names, and the planner; what they achieve in the scenes is in test_scenes.py."""

from itertools import product
from typing import get_args

import numpy as np
import pytest
import shapely

from flowrep.baselines import BASELINES, Planner
from flowrep.baselines.planner import GoalDistance
from flowrep.config.options import BaselineName


def test_the_commands_know_every_baseline():
    assert set(BASELINES) == set(get_args(BaselineName))


def test_the_planner_replans_after_other_actions(make_street, empty_road):
    env = make_street(empty_road, sensors=())
    planner = Planner()
    env.reset(seed=0)
    planner(env)
    for action in (1, 1, 0, 2, 2):  # not its own choice: the vehicle now heads for the kerb
        env.step(action)
    while not env.episode.outcome:
        env.step(planner(env))
    assert env.episode.outcome.label == "success"


def test_the_speed_blind_planners_plan_does_not_depend_on_speed(make_street):
    plans = {True: [], False: []}
    for sees_speed, speed_mps in product(plans, ((0.5, 0.5), (2.5, 2.5))):
        env = make_street(speed=speed_mps, sensors=())
        env.reset(seed=0)  # the same people at the same places
        planner = Planner((100,), sees_speed=sees_speed)
        plans[sees_speed].append(planner.search(env.episode))
    assert plans[False][0] == plans[False][1]
    assert plans[True][0] != plans[True][1]


def test_the_goal_distance_leads_round_corners():
    # An L: 10 m along x, then 10 m along y, 2 m wide; the goal is its upper end.
    corner = shapely.union(shapely.box(0, 0, 10, 2), shapely.box(8, 0, 10, 10))
    way = GoalDistance(corner, shapely.box(8, 9, 10, 10))
    start, bend, goal, outside = way(np.array([0.6, 9.1, 9.0, 4.0]), np.array([1.1, 1.1, 9.6, 6.0]))
    assert goal == 0.0
    assert bend == pytest.approx(8.0, abs=0.6)
    # Straight through the corner's inside it would be 11.5 m; along it about 15.
    assert 13.5 < start < 17
    assert outside == np.inf
    assert way(np.array([100.0]), np.array([-100.0]))[0] == np.inf
