"""A policy of your own on flowrep's benchmark: it steers around people by their object flow.

    python -m flowrep.evaluate policy=examples/own_policy.py:make 'representations=[obj,depth]' \
        scene=straight_road

The policy does not learn. From object flow and depth it predicts where people will be when the
vehicle reaches them. If they are in the way, it steers to the other side of the road, and returns
to the middle once the way is clear. It infers each vehicle's position from its previous actions.
"""

import math

import torch

GO_ON, LEFT, RIGHT = 0, 1, 2
STEP_S, SPEED_MPS, TURN_DPS2 = 1 / 12, 10.0, 35.0  # of straight_road at 12 frames a second
TURN_DPS = TURN_DPS2 * STEP_S  # change of the yaw rate by one action
RANGE_M = 100.0  # of representations=[depth]
NEAR_M, IN_THE_WAY_M, EVADE_M = 25.0, 1.5, 2.0


def make(task):
    """Returns a function from maps [N, C, H, W] to actions [N]."""
    K = task.intrinsics.to(task.device)
    column = torch.arange(task.observation_spec["obj"].shape[-1], device=task.device) + 0.5
    pilots = {}  # by env

    def act(maps):
        flow, depth_m = maps["obj"], RANGE_M * maps["depth"][:, 0]
        steps = depth_m / (SPEED_MPS * STEP_S)  # until the vehicle reaches the point
        right_m = depth_m * (column - K[0, 2] + steps * flow[:, 0]) / K[0, 0]  # at that time
        near = (flow.norm(dim=1) > 0.05) & (depth_m < NEAR_M)  # moving, in pixels a step
        in_the_way = near & (right_m.abs() < IN_THE_WAY_M)
        actions = []
        for row, env_id in enumerate(maps["env_id"].tolist()):
            if maps["is_init"][row]:
                pilots[env_id] = Pilot()
            people_m = right_m[row][in_the_way[row]]
            goal_m = math.copysign(EVADE_M, people_m.mean()) if len(people_m) else 0.0
            actions.append(pilots[env_id].steer(goal_m))
        return torch.tensor(actions)

    return act


class Pilot:
    """Steers to a given distance from the middle of the road, positive to the left."""

    def __init__(self):
        """Starts in the middle of the road, facing along it."""
        self.rate_dps = self.heading_deg = self.left_m = 0.0

    def steer(self, goal_m):
        """Returns the next action: the distance sets a heading, the heading sets a yaw rate."""
        heading_deg = limited(7 * (goal_m - self.left_m), 10)
        rate_dps = limited(5 * (heading_deg - self.heading_deg), 17)
        turn = round(limited((rate_dps - self.rate_dps) / TURN_DPS, 1))
        self.rate_dps += turn * TURN_DPS
        self.heading_deg += self.rate_dps * STEP_S
        self.left_m += SPEED_MPS * STEP_S * math.sin(math.radians(self.heading_deg))
        return (GO_ON, LEFT, RIGHT)[turn]


def limited(value, limit):
    """Returns the value nearest to `value` from -limit to limit."""
    return max(-limit, min(limit, value))
