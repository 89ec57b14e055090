"""Recordings with a broken file: read and factorised, or refused in a line that names the file."""

import random
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowrep.sequences import (
    Frames,
    Recording,
    SequenceError,
    factorize_frames,
    recorded_flow,
    write_kitti_flow,
)
from tests.fuzz.framework import Part
from tests.sequences import synthetic
from tests.sequences.test_readers import FORMATS

_NUMBERS = (b"nan", b"inf", b"-inf", b"-1", b"0", b"1e309", b"1e38", b"9" * 5000, b"2147483648")
_WORDS = (
    b"",
    b"x",
    b"../../x.png",
    b"/etc/passwd",
    b"a\x00b",
    b"\xff\xfe",
    b"\xc3\xa9",
    b"#",
    b",",
)
_INTS = (0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1)


class Broken(NamedTuple):
    """A file of a recording, and what it holds instead; None for nothing at all."""

    format: str
    file: str
    content: bytes | None


def _write_other_files(folder: Path) -> None:
    """Writes the plain layout again, of the file types that `write_frames` leaves out."""
    import cv2

    moments = synthetic.write_frames(folder)
    for i, moment in enumerate(moments):
        (folder / f"rgb/{i:04d}.png").unlink()
        (folder / f"depth/{i:04d}.png").unlink()
        cv2.imwrite(str(folder / f"rgb/{i:04d}.jpg"), moment.rgb)
        np.save(folder / f"depth/{i:04d}.npy", moment.depth)
        if i > 0:
            (folder / f"flow/{i:04d}.flo").unlink()
            write_kitti_flow(folder / f"flow/{i:04d}.png", moment.raw)


@cache
def _temporary() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory(prefix="flowrep_fuzz_")


@cache
def _bases() -> dict[str, tuple[Path, Callable[[Path], Recording]]]:
    """Returns a folder and what opens it, by format; written once."""
    root = Path(_temporary().name)
    writers = {name: (write, open_it) for name, (write, open_it, *_) in FORMATS.items()}
    writers["frames of other files"] = (_write_other_files, Frames)
    for name, (write, _) in writers.items():
        write(root / name)
    return {name: (root / name, open_it) for name, (_, open_it) in writers.items()}


def draw(rng: random.Random) -> Broken:
    """Returns a recording's file with an odd change."""
    name = rng.choice(sorted(_bases()))
    folder, _ = _bases()[name]
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = rng.choice(files)
    content = path.read_bytes()
    changes: list[Callable[[], bytes | None]] = [
        lambda: None,
        lambda: content[: rng.randrange(len(content))],
        lambda: content + rng.randbytes(rng.randrange(1, 99)),
        lambda: rng.choice(files).read_bytes(),
        lambda: rng.randbytes(rng.randrange(999)),
        lambda: _with_bytes(content, rng, rng.randrange(1, 9)),
        lambda: _with_integer(content, rng),
    ]
    if path.suffix in (".txt", ".json"):
        changes += 4 * [lambda: _with_word(content, rng), lambda: _with_lines(content, rng)]
    if path.suffix == ".png":
        changes += 4 * [lambda: _with_png_chunk(content, rng)]
    return Broken(name, str(path.relative_to(folder)), rng.choice(changes)())


def _with_bytes(content: bytes, rng: random.Random, count: int) -> bytes:
    changed = bytearray(content)
    for _ in range(count):
        changed[rng.randrange(min(len(changed), rng.choice((16, 64, 10**9))))] = rng.randrange(256)
    return bytes(changed)


def _with_integer(content: bytes, rng: random.Random) -> bytes:
    """Headers say their sizes in four bytes."""
    place = rng.randrange(0, max(1, min(len(content) - 4, 64)))
    code = rng.choice(("<I", ">I"))
    return content[:place] + struct.pack(code, rng.choice(_INTS)) + content[place + 4 :]


def _with_word(content: bytes, rng: random.Random) -> bytes:
    words = content.split(b" ")
    words[rng.randrange(len(words))] = rng.choice((*_NUMBERS, *_WORDS))
    return b" ".join(words)


def _with_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    change = rng.choice(("shuffle", "repeat", "drop", "join"))
    if change == "shuffle":
        rng.shuffle(lines)
    elif change == "repeat":
        lines *= rng.randrange(2, 50)
    elif change == "drop":
        del lines[rng.randrange(len(lines))]
    else:
        lines = [b"".join(lines).replace(b"\n", b" ")]
    return b"".join(lines)


def _with_png_chunk(content: bytes, rng: random.Random) -> bytes:
    """Changes a byte of a chunk and mends its check sum, which would give it away."""
    chunks, place = [], 8
    while place < len(content):
        (length,) = struct.unpack_from(">I", content, place)
        chunks.append(bytearray(content[place + 4 : place + 8 + length]))
        place += 12 + length
    chunk = rng.choice(chunks)
    if len(chunk) > 4:
        place = rng.randrange(4, len(chunk))
        chunk[place] = rng.choice((0, 1, 255, rng.randrange(256)))
    made = content[:8]
    for chunk in chunks:
        made += struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return made


def run(broken: Broken) -> str:
    """Reads and factorises the recording, then mends it again."""
    folder, open_it = _bases()[broken.format]
    path = folder / broken.file
    whole = path.read_bytes()
    try:
        if broken.content is None:
            path.unlink()
        else:
            path.write_bytes(broken.content)
        return _outcome(open_it, folder)
    finally:
        path.write_bytes(whole)


def _outcome(open_it: Callable[[Path], Recording], folder: Path) -> str:
    try:
        recording = open_it(folder)
        source: Any = recorded_flow if recording.has_flow else _no_flow
        frames = 0
        for made in factorize_frames(recording, source):
            frames += 1
            if made is not None and not np.isfinite(made.obj).all():
                raise AssertionError("object flow is not finite")
        return f"read {'all' if frames in (2, 3) else 'other'} frames"
    except SequenceError as refusal:
        said = str(refusal)
        if "\n" in said or not said.startswith(str(folder)) or len(said) > 2000:
            raise AssertionError(f"a refusal of other form: {said[:300]!r}") from refusal
        return "refused"


def _no_flow(previous: Any, current: Any) -> Any:
    return np.zeros((2, *current.size), np.float32)


def setup() -> None:
    """Writes the recordings and reads each once."""
    for name, (folder, open_it) in _bases().items():
        if _outcome(open_it, folder) == "refused":
            raise AssertionError(f"{name} is refused as it is")


PART = Part("recordings", draw, run, setup)
