"""conf/representations: one file a representation, its options those of the code."""

from __future__ import annotations

import pytest

from flowrep.config import CONF_DIR, group_choices
from flowrep.transforms import REPRESENTATIONS, representation_options, representation_stack

yaml = pytest.importorskip("yaml")

K = [[42.0, 0.0, 42.0], [0.0, 42.0, 42.0], [0.0, 0.0, 1.0]]


def read(name: str) -> dict:
    return yaml.safe_load((CONF_DIR / "representations" / f"{name}.yaml").read_text())


def test_there_is_a_file_for_each_representation():
    assert sorted(REPRESENTATIONS) == group_choices("representations")


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_file_names_the_representation_and_spells_its_options(name):
    config = read(name)
    assert list(config) == [name]
    assert list(config[name]) == list(representation_options(name))


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_an_experiment_changes_nothing_of_a_representation(name):
    # the flows' scale among it: one factor for all, so that scale decides no comparison
    assert read(name)[name] == representation_options(name)


def test_all_files_together_make_a_stack():
    chosen = {name: read(name)[name] for name in REPRESENTATIONS}
    assert representation_stack(chosen, intrinsics=K, num_classes=5)
