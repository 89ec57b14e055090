"""A policy of your own on flowrep's benchmark: it steers away from moving objects ahead.

    python -m flowrep.evaluate policy=examples/own_policy.py:make representations=[obj,depth] \
        scene=straight_road

It does not learn. If something moves on its own within 12 m, it turns to the other side, and back
once the way is clear. It counts its turns separately for each environment.
"""

import torch

GO_ON, LEFT, RIGHT = 0, 1, 2
NEAR = 0.12  # fraction of depth's range of 100 m


def make(task):
    """Returns a function from maps [N, C, H, W] to actions [N]."""
    width = task.observation_spec["obj"].shape[-1]
    ahead = slice(width // 4, width - width // 4)
    turned = {}  # by environment: left turns minus right turns

    def act(maps):
        actions = []
        moves = maps["obj"].norm(dim=-3) > 0.05  # pixels a step
        near = moves & (maps["depth"][:, 0] < NEAR)
        for street, is_init, seen in zip(maps["street"].tolist(), maps["is_init"], near):
            if is_init:
                turned[street] = 0
            columns = seen[:, ahead].any(dim=0).nonzero()
            if len(columns):
                action = RIGHT if columns.float().mean() < (ahead.stop - ahead.start) / 2 else LEFT
            else:
                action = (GO_ON, RIGHT, LEFT)[(turned[street] > 0) - (turned[street] < 0)]
            turned[street] += (0, 1, -1)[action]
            actions.append(action)
        return torch.tensor(actions)

    return act
