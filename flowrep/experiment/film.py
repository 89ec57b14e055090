"""Films of episodes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, TensorSpec

from flowrep.envs import street_envs
from flowrep.experiment.evaluation import Driver, evaluate
from flowrep.experiment.outcomes import EpisodeRecord
from flowrep.experiment.schema import EnvConfig
from flowrep.transforms import representation_stack
from flowrep.transforms.representations import (
    FLOWS,
    FRAMES_OF,
    REPRESENTATIONS,
    flow_scale,
    representation_options,
)
from flowrep.viz import (
    OUTCOME_COLOURS,
    Image,
    Tile,
    classes_to_rgb,
    grey_to_rgb,
    representation_strip,
    stock_tiles,
    write_video,
)
from flowrep.viz.maps import text_bar, tile_zoom

OUTCOME_S = 1.0
"""Seconds for which a film shows the outcome at its end."""

_MOST_TILES = 4  # of a representation that is drawn channel by channel
_STATUS_PX = 28
_ACTIONS = ("keeps its yaw rate", "turns left", "turns right")  # in the order of the actions

Units = Callable[[Tensor], Tensor]


class FilmFrame(NamedTuple):
    """What a film shows of one step."""

    maps: dict[str, Tensor]  # [C, H, W] by tile; ids, metres or px per step
    steps: int  # of the episode so far
    action: int | None  # chosen at this frame; None in the last one


class Film:
    """Drives an agent in an env of one street and draws its steps, with a tile for each map.

    Maps that the agent reads are drawn as its env's transforms write them, noisy or estimated, with
    a border. The others of rgb, seg, depth, raw, ego and obj are computed from exact sensors.

    Args:
        agent: the agent whose policy drives.
        changes: arguments of `make_env` to replace.

    Attributes:
        env: one street, with its sensors.
        tiles: the tiles by name; remove some to draw less.
        framed: the names of the tiles that the agent reads.
    """

    def __init__(self, agent: Driver, **changes: Any) -> None:
        self.agent = agent
        read = agent.config.representations
        self.env = agent.make_env(
            representations={**read, "rgb": read.get("rgb")},
            keep_sensor=True,
            num_envs=1,
            num_workers=0,
            picture_scale=_picture_scale(agent.config),
            **changes,
        )
        (self.street,) = street_envs(self.env)
        self.tiles = stock_tiles()
        # Appended behind the agent's transforms, these read the sensors as they are, without noise.
        if exact := [name for name in self.tiles if name not in (*read, "rgb")]:
            K, num_classes = torch.from_numpy(self.street.K), self.street.num_classes
            stack = representation_stack(exact, intrinsics=K, num_classes=num_classes)
            self.env.append_transform(stack)
        self.framed = [name for name in read if name in self.tiles]
        self._rate_hz = self.env.base_env.frame_rate_hz
        # By tile: the key of its map, and the function that converts the map to the tile's units.
        self._maps = {
            name: (name, in_units(name, read.get(name), self._rate_hz)) for name in self.tiles
        }
        height, width = self.env.observation_spec["seg"].shape[-2:]
        zoom = tile_zoom(height, width)
        self._tile_size = zoom * height, zoom * width
        for name in read:
            if name not in self._maps:
                self._add_tiles(name, read[name])

    def _add_tiles(self, name: str, options: Mapping[str, Any] | None) -> None:
        """Adds tiles for a representation without a stock tile: one per frame, or per channel.

        A map of another ratio of height to width gets none, because it doesn't fit the strip.
        """
        spec, units = self.env.observation_spec[name], in_units(name, options, self._rate_hz)
        channels, rows, columns = spec.shape[-3:]
        height, width = self._tile_size
        if rows * width != columns * height:
            return
        if name in FRAMES_OF:
            tile, count = self.tiles[FRAMES_OF[name]], known_options(name, options)["k"]
        else:
            tile, count = Tile(name, _colours_of(spec)), channels
        for i in range(min(count, _MOST_TILES)):
            # `i` is bound here: the closure alone would see the last one of the loop.
            def part(values: Tensor, i: int = i) -> Tensor:
                return units(values.chunk(count)[i])

            label = name if count == 1 else f"{name}, {i + 1} of {count}"
            self.tiles[label] = tile._replace(label=label)
            self._maps[label] = name, part
            self.framed.append(label)

    def drive(
        self,
        options: Mapping[str, Any],
        on_frame: Callable[[TensorDictBase], Any] = lambda tensordict: None,
    ) -> tuple[list[FilmFrame], EpisodeRecord]:
        """Returns the frames of one greedy episode, and its record.

        `options` are those of `StreetEnv.reset`; `on_frame` gets the env's TensorDict.
        """
        frames: list[FilmFrame] = []

        def keep(tensordict: TensorDictBase) -> None:
            maps = {tile: to(tensordict[key][0].cpu()) for tile, (key, to) in self._maps.items()}
            action = int(tensordict["action"]) if "action" in tensordict else None
            frames.append(FilmFrame(maps, self.street.episode.steps, action))
            on_frame(tensordict)

        (episode,) = evaluate(self.env, self.agent.policy, [options], on_frame=keep)
        return frames, episode

    def draw(self, frame: FilmFrame, ended: EpisodeRecord | None = None) -> Image:
        """Returns a frame's picture, with the outcome of the episode if it has `ended`."""
        classes = self.street.scene.categories
        drawn = representation_strip(
            frame.maps, tiles=self.tiles, framed=self.framed, categories=classes
        )
        if ended is None:
            seconds = frame.steps / self.street.frame_rate_hz
            status = f"{seconds:.1f} s   {'' if frame.action is None else _ACTIONS[frame.action]}"
            colour = "#ffffff"
        else:
            status, colour = how_it_ended(ended), OUTCOME_COLOURS[ended.outcome]
        red, green, blue = bytes.fromhex(colour[1:])
        grey = 255 if red + green + blue < 400 else 40  # readable on the colour
        colours: Any = {"colour": (grey,) * 3, "background": (red, green, blue)}
        bar = text_bar(status, drawn.shape[1], _STATUS_PX, size=16, **colours)
        return np.concatenate([drawn, bar])

    def pictures(self, frames: Sequence[FilmFrame], episode: EpisodeRecord) -> Iterator[Image]:
        """Yields the pictures of a film: the episode, and its outcome."""
        yield from map(self.draw, frames[:-1])
        last = self.draw(frames[-1], episode)
        yield from repeat(last, max(1, round(OUTCOME_S * episode.fps)))

    def close(self) -> None:
        """Closes the env."""
        self.env.close()


def record_episode(
    agent: Driver, path: Path, *, episode_seed: int, **changes: Any
) -> EpisodeRecord:
    """Writes the film of one greedy episode, and returns its record; for `changes` see `Film`."""
    with closing(Film(agent, **changes)) as film:
        frames, episode = film.drive({"episode_seed": episode_seed})
        write_video(path, film.pictures(frames, episode), fps=episode.fps)
    return episode


def how_it_ended(episode: EpisodeRecord) -> str:
    """Returns an episode's outcome in words."""
    hit = f" ({episode.hit})" if episode.hit else ""
    what = f"{episode.outcome}{hit}".replace("_", " ")
    return f"{what} after {episode.length / episode.fps:.1f} s, return {episode.return_:.2f}"


def known_options(name: str, given: Mapping[str, Any] | None) -> dict[str, Any]:
    """Returns a representation's options; none of a user's transform, as they may mean anything."""
    return representation_options(name) | dict(given or {}) if name in REPRESENTATIONS else {}


def in_units(name: str, given: Mapping[str, Any] | None, frame_rate_hz: float) -> Units:
    """Returns the function that converts a representation to ids, metres or pixels per step."""
    options = known_options(name, given)
    if "encoding" in options:
        return lambda ids: ids if len(ids) == 1 else ids.argmax(0, keepdim=True).byte()
    if "range_m" in options:  # 1 is the range or beyond it, like the sky
        return lambda depth: torch.where(depth < 1, depth * options["range_m"], torch.inf)
    if name not in FLOWS:
        return lambda values: values
    scale = flow_scale(options, frame_rate_hz)
    return lambda values: values / scale


def _picture_scale(config: EnvConfig) -> int:
    """Returns the factor from the maps' size to that of rgb.

    rgb is rendered at the size of a tile, unless the agent reads it. Estimators of flow get
    pictures of the config's size in any case.
    """
    if "rgb" in config.representations:
        return 1
    return tile_zoom(config.scene.camera.height_px, config.scene.camera.width_px)


def _colours_of(spec: TensorSpec) -> Callable[[Any], Image]:
    """Returns the function that draws a channel of a map of this spec, in grey or as classes."""
    if isinstance(spec, Categorical):
        return classes_to_rgb
    low, high = float(spec.space.low.min()), float(spec.space.high.max())
    # The bounds of an unbounded spec are those of its dtype, which would leave one grey.
    return partial(grey_to_rgb, low=low, high=high) if high - low < 1e6 else grey_to_rgb
