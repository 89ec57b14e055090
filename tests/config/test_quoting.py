"""A text with any characters arrives in the config as it is, through shell and Hydra."""

import random
import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from flowrep.config.quoting import override, shell_line, taken_as_typed

ODD = [
    "outputs/a", "a=b", "a,b", "[x]", "{a:b}", "it's", 'say "hi"', "both ' and \"", "a b", " a ",
    "josé", "日本", "$HOME", "${x}", "\\${x}", "$${x}", "a\\", "a\\'", "\\\\'", "#a", "~a", "-a",
    "2026", "true", "null", "1e5", "a:b", "choice(a,b)", "???", "'x'", "a\nb", "%", "!x", "*",
]  # fmt: skip


def read(line):
    """Returns what a config holds after a line was typed into a shell."""
    overrides = OverridesParser.create().parse_overrides(shlex.split(line)[1:])
    config = OmegaConf.create()
    for one in overrides:
        OmegaConf.update(config, one.key_or_group, one.value())
    return OmegaConf.to_container(config, resolve=True)


@pytest.mark.parametrize("text", ODD)
def test_a_pasted_line_gives_the_very_text(text):
    assert read(shell_line("flowrep-train", override("resume", text))) == {"resume": text}


def test_so_does_a_line_of_any_characters():
    draw = random.Random(0)
    characters = "a1=,[]{}'\"\\$ é日#%~+-:()!&;*?`|<>@^\t."
    for _ in range(100):
        text = "".join(draw.choice(characters) for _ in range(draw.randint(1, 8)))
        assert read(shell_line("flowrep-train", override("resume", text))) == {"resume": text}


def test_what_needs_no_quotes_has_none():
    assert shell_line("a", override("resume", "outputs/2026-01-31/12_ego+obj_s1")) == (
        "a resume=outputs/2026-01-31/12_ego+obj_s1"
    )


def test_a_folder_that_is_there_is_taken_as_it_was_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a,b=[c]").mkdir()
    (typed,) = taken_as_typed(["resume=a,b=[c]"], ["resume"])
    assert read(shell_line("flowrep-train", typed)) == {"resume": "a,b=[c]"}
    others = ["resume=nowhere,b", "seed=a,b=[c]", "--multirun", "resume="]
    assert taken_as_typed(others, ["resume"]) == others


@pytest.mark.parametrize("name", ["20240501", "1e3", "0x10", "true", "inf"])
def test_a_folder_named_like_a_number_is_a_folder(name):
    typed = taken_as_typed(
        [f"output={name}", f"input={name}", "seed=7"], ["output", "input"], ["input"]
    )
    assert read(shell_line("flowrep-factorize", typed[0])) == {"output": name}
    assert typed[1:] == [f"input={name}", "seed=7"]
