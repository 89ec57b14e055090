"""Films of episodes."""

import math
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image as pillow
from PIL import ImageDraw
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical

from flowrep.baselines import BaselinePolicy
from flowrep.envs import street_envs
from flowrep.experiment.evaluation import Driver, evaluate
from flowrep.experiment.outcomes import EpisodeRecord
from flowrep.scenes.vehicle import YAW_SIGN
from flowrep.transforms import representation_stack
from flowrep.transforms.stack import FLOWS, FRAMES_OF, REPRESENTATIONS, representation_options
from flowrep.viz import (
    Image,
    Tile,
    classes_to_rgb,
    flow_wheel,
    grey_to_rgb,
    representation_strip,
    stock_tiles,
    write_video,
)
from flowrep.viz.maps import OUTCOME_COLOURS, class_legend, resized, text_bar, tile_zoom, written

LEGEND_S, OUTCOME_S = 3.0, 1.0
"""Seconds for which a film shows the legend at its start, and the outcome at its end."""

_MOST_TILES = 4  # of a representation that is drawn channel by channel
_STATUS_PX = 28
_WHEEL_PX = 60
_RIM_PX = 6
_RIM, _ARROW = (250, 250, 250), (255, 210, 0)
_TEXT_PX = 15
_LINE_PX = 19
_ACTIONS = ("keeps its yaw rate", "turns left", "turns right")  # in the order of YAW_SIGN


class FilmFrame(NamedTuple):
    """What a film shows of one step."""

    maps: dict[str, Tensor]  # [C, H, W] by tile; ids, metres or px per step
    steps: int  # of the episode so far
    turned: float  # the yaw rate over the largest one, positive to the left
    action: int | None = None  # chosen at this frame; None if unknown, as in the last frame


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
            picture_scale=_picture_scale(agent),
            **changes,
        )
        (self.street,) = street_envs(self.env)
        policy = agent.policy
        self.policy = BaselinePolicy(policy, self.env) if isinstance(policy, str) else policy
        self.tiles = stock_tiles()
        rgb = self.tiles["rgb"]
        self.tiles["rgb"] = rgb._replace(about=f"{rgb.about} Wheel: yaw rate. Arrow: action.")
        if exact := [name for name in self.tiles if name not in (*read, "rgb")]:
            context: dict[str, Any] = {
                "intrinsics": torch.from_numpy(self.street.K),
                "num_classes": self.street.num_classes,
            }
            self.env.append_transform(representation_stack(exact, **context))
        self.framed = [name for name in read if name in self.tiles]
        # By tile: the key of its map, and the function that converts the map to the tile's units.
        self._maps = {name: (name, self._in_units(name)) for name in self.tiles}
        height, width = self.env.observation_spec["seg"].shape[-2:]
        zoom = tile_zoom(height, width)
        self._tile_size = zoom * height, zoom * width
        for name in read:
            if name not in self._maps:
                self._add_tiles(name)

    def drive(
        self,
        options: Mapping[str, Any],
        on_frame: Callable[[TensorDictBase], Any] = lambda tensordict: None,
    ) -> tuple[list[FilmFrame], EpisodeRecord]:
        """Returns the frames of one greedy episode, and its record.

        `options` are those of `StreetEnv.reset`; `on_frame` gets the env's TensorDict.
        """
        frames: list[FilmFrame] = []

        def note(tensordict: TensorDictBase) -> TensorDictBase:
            acted = self.policy(tensordict)
            frames[-1] = frames[-1]._replace(action=int(acted["action"]))
            return acted

        def keep(tensordict: TensorDictBase) -> None:
            frames.append(self.frame(tensordict))
            on_frame(tensordict)

        (episode,) = evaluate(self.env, note, [options], on_frame=keep)
        return frames, episode

    def frame(self, tensordict: TensorDictBase) -> FilmFrame:
        """Returns the frame that shows the env's TensorDict and the street's current state."""
        maps = {tile: make(tensordict[key][0].cpu()) for tile, (key, make) in self._maps.items()}
        episode, vehicle = self.street.episode, self.street.scene.vehicle
        turned = episode.now.vehicle.yaw_rate_rps / math.radians(vehicle.max_yaw_rate_dps)
        return FilmFrame(maps, episode.steps, turned)

    def draw(self, frame: FilmFrame, ended: EpisodeRecord | None = None) -> Image:
        """Returns a frame's picture, with the outcome of the episode if it has `ended`."""
        tiles = dict(self.tiles)
        if rgb := tiles.get("rgb"):
            sign = 0.0 if frame.action is None else YAW_SIGN[frame.action]

            def draw(picture: Tensor) -> Image:
                enlarged = resized(rgb.draw(picture), *self._tile_size)
                return with_steering(enlarged, frame.turned, sign)

            tiles["rgb"] = rgb._replace(draw=draw)
        classes = self.street.scene.categories
        drawn = representation_strip(
            frame.maps, tiles=tiles, framed=self.framed, categories=classes
        )
        if ended is not None:
            return _above(drawn, how_it_ended(ended), OUTCOME_COLOURS[ended.outcome])
        action = "" if frame.action is None else _ACTIONS[frame.action]
        return _above(drawn, f"{frame.steps / self.street.frame_rate_hz:.1f} s   {action}")

    def legend(self) -> Image:
        """Returns a picture, as large as the frames' pictures, that explains them."""
        classes = self.street.scene.categories
        keys = {"rgb": steering(0.3, 1.0), "seg": class_legend(classes, self._tile_size[1])}
        wheel = flow_wheel(min(self._tile_size) // 2)
        pages = {}
        for name, tile in self.tiles.items():
            key = wheel if tile.is_flow else keys.get(name)
            draw = partial(_page, self._tile_size, key=key)
            pages[name] = tile._replace(draw=draw, is_flow=False)
        texts = {name: tile.about for name, tile in self.tiles.items()}
        drawn = representation_strip(texts, tiles=pages, framed=self.framed, categories=classes)
        name = self.agent.policy if isinstance(self.agent.policy, str) else "the agent"
        if self.framed:
            return _above(drawn, f"framed: what {name} reads; the other maps are exact")
        return _above(drawn, f"{name} reads none of these maps")

    def pictures(self, frames: Sequence[FilmFrame], episode: EpisodeRecord) -> Iterator[Image]:
        """Yields the pictures of a film: the legend, the episode, and its outcome."""
        yield from repeat(self.legend(), max(1, round(LEGEND_S * episode.fps)))
        yield from map(self.draw, frames[:-1])
        last = self.draw(frames[-1], episode)
        yield from repeat(last, max(1, round(OUTCOME_S * episode.fps)))

    def close(self) -> None:
        """Closes the env."""
        self.env.close()

    def _options(self, name: str) -> dict[str, Any]:
        if name not in REPRESENTATIONS:  # a user's transform, whose options may mean anything
            return {}
        given = self.agent.config.representations.get(name) or {}
        return representation_options(name) | dict(given)

    def _in_units(self, name: str) -> Callable[[Tensor], Tensor]:
        """Returns the function that converts a map to ids, metres or pixels per step."""
        options = self._options(name)
        if "encoding" in options:
            return lambda ids: ids if len(ids) == 1 else ids.argmax(0, keepdim=True).byte()
        if "range_m" in options:  # 1 is the range or beyond it, like the sky
            return lambda depth: torch.where(depth < 1, depth * options["range_m"], torch.inf)
        if name in FLOWS:
            return lambda flow: flow / options["scale"]
        return lambda values: values

    def _add_tiles(self, name: str) -> None:
        """Adds tiles for a representation without a stock tile: one per frame, or per channel.

        A map of another ratio of height to width gets none.
        """
        spec, in_units = self.env.observation_spec[name], self._in_units(name)
        height, width = self._tile_size
        if spec.shape[-2] * width != spec.shape[-1] * height:
            return  # it doesn't fit a strip of the camera's pictures
        if frames_of := FRAMES_OF.get(name):
            tile, count = self.tiles[frames_of], int(self._options(name)["k"])
            tile = tile._replace(about=f"{tile.about} The last {count} frames, oldest first.")
        else:
            tile, count = Tile(name, _plain(spec), about="As the agent reads it."), spec.shape[-3]
        for i in range(min(count, _MOST_TILES)):

            def part(values: Tensor, i: int = i) -> Tensor:
                return in_units(values.chunk(count)[i])

            label = name if count == 1 else f"{name}, {i + 1} of {count}"
            self.tiles[label] = tile._replace(label=label)
            self._maps[label] = name, part
            self.framed.append(label)


def record_episode(
    agent: Driver, path: Path, *, episode_seed: int, **changes: Any
) -> EpisodeRecord:
    """Writes the film of one greedy episode, and returns its record; for `changes` see `Film`."""
    with closing(Film(agent, **changes)) as film:
        frames, episode = film.drive({"episode_seed": episode_seed})
        pictures = film.pictures(frames, episode)
        write_video(path, pictures, fps=episode.fps)
    return episode


def how_it_ended(episode: EpisodeRecord) -> str:
    """Returns an episode's outcome in words."""
    hit = f" ({episode.hit.replace('_', ' ')})" if episode.hit else ""
    words = episode.outcome.replace("_", " ")
    seconds = episode.length / episode.fps
    return f"{words}{hit} after {seconds:.1f} s, return {episode.return_:.2f}"


def _picture_scale(agent: Driver) -> int:
    """Returns the factor from the maps' size to that of rgb.

    rgb is rendered at the size of a tile, unless the agent reads it. Estimators of flow get
    pictures of the config's size in any case.
    """
    config = agent.config
    if "rgb" in config.representations or config.renderer == "pybullet":
        return 1
    return tile_zoom(config.scene.camera.height_px, config.scene.camera.width_px)


def _plain(spec: Any) -> Callable[[Any], Image]:
    """Returns the function that draws a channel of a map of this spec, in grey or as classes."""
    if isinstance(spec, Categorical):
        return classes_to_rgb
    low, high = float(spec.space.low.min()), float(spec.space.high.max())
    return partial(grey_to_rgb, low=low, high=high) if high - low < 1e6 else grey_to_rgb


def _above(picture: Image, text: str, colour: str = "#ffffff") -> Image:
    """Returns a picture with a coloured bar below it, which shows a line of text."""
    background: Any = tuple(bytes.fromhex(colour[1:]))
    grey = 255 if sum(background) < 400 else 40
    bar = text_bar(
        text, picture.shape[1], _STATUS_PX, size=16, colour=(grey,) * 3, background=background
    )
    return np.concatenate([picture, bar])


def steering(turned: float, sign: float = 0.0, background: Image | None = None) -> Image:
    """Returns a steering wheel between two arrows, `[60, 120, 3]`.

    Args:
        turned: the yaw rate as a share of the largest, positive to the left; at 1 the wheel is
            turned by 90° to the left.
        sign: of the chosen action, positive to the left; 0 draws no arrow.
        background: an image of the same size to draw on; grey if None.
    """
    if background is None:
        background = np.full((_WHEEL_PX, 2 * _WHEEL_PX, 3), 90, np.uint8)
    fine = 4  # drawn larger and scaled down, as Pillow draws without antialiasing
    width, height = fine * 2 * _WHEEL_PX, fine * _WHEEL_PX
    picture = pillow.fromarray(background).resize((width, height))
    draw, x, y = ImageDraw.Draw(picture), width / 2, height / 2
    radius = height / 2 - 2 * fine
    for thickness, colour in ((_RIM_PX + 2, (20, 20, 20)), (_RIM_PX, _RIM)):
        inset = radius - fine * (_RIM_PX - thickness) / 2
        box = (x - inset, y - inset, x + inset, y + inset)
        draw.ellipse(box, outline=colour, width=fine * thickness)
        for spoke_deg in (0, 180, 270):  # right, left and down; counter-clockwise is left
            angle = math.radians(spoke_deg + 90 * turned)
            rim = x + math.cos(angle) * radius * 0.9, y - math.sin(angle) * radius * 0.9
            draw.line((x, y, *rim), fill=colour, width=fine * (thickness - 1))
    if sign:
        side = -math.copysign(1, sign)  # left is -x
        tip, base = x + side * (radius + fine * 26), x + side * (radius + fine * 6)
        arrow = [(tip, y), (base, y - fine * 14), (base, y + fine * 14)]
        draw.polygon(arrow, fill=_ARROW, outline=(20, 20, 20), width=fine)
    return np.asarray(picture.resize((2 * _WHEEL_PX, _WHEEL_PX), pillow.Resampling.BOX))


def with_steering(image: Image, turned: float, sign: float = 0.0) -> Image:
    """Returns an image with a steering wheel in the middle of its lower edge, if there is room."""
    height, width = image.shape[:2]
    top, left = height - _WHEEL_PX - 6, (width - 2 * _WHEEL_PX) // 2
    if top < 0 or left < 0:
        return image
    area = slice(top, top + _WHEEL_PX), slice(left, left + 2 * _WHEEL_PX)
    image = image.copy()
    image[area] = steering(turned, sign, image[area])
    return image


def _page(size: tuple[int, int], text: str, key: Image | None) -> Image:
    """Returns wrapped text on white, and a picture in the middle of the space below."""
    height, width = size
    page = np.full((height, width, 3), 255, np.uint8)
    lines = textwrap.wrap(text, max(10, width // 8))
    if key is not None:
        top = _LINE_PX * len(lines) + 12
        key = key[: max(0, height - top), :width]
        left = (width - key.shape[1]) // 2
        top += (height - top - len(key)) // 2
        page[top : top + len(key), left : left + key.shape[1]] = key
    texts = {
        (6, 8 + _LINE_PX // 2 + _LINE_PX * i): (line, "lm", (40, 40, 40))
        for i, line in enumerate(lines)
    }
    return written(page, texts, size=_TEXT_PX) if texts else page
