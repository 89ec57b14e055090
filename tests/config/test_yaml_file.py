"""YAML of a user, or of a stranger, is data, or one line that says what is wrong with it."""

import pytest

from flowrep.config.usage import UsageError
from flowrep.config.yaml_file import read_yaml

WRONG = {
    "a list that is not closed": (b"name: a\nroads: [1\n", ", line 3: "),
    "a key twice": (b"name: a\nname: b", ", line 2: the key 'name'"),
    "a tag that calls": (b"!!python/object/apply:os.system ['touch PWNED']", ", line 1: "),
    "a tag of a module": (b"a: !!python/name:os.system", ", line 1: "),
    "a date that is none": (b"a: 2001-99-99", ": "),
    "a tagged date that is none": (b"a: !!timestamp x", ": "),
    "a truth that is none": (b"a: !!bool x", ": "),
    "no UTF-8": (b"name: \xff\xfe", ": "),
    "depth": (b"name: " + b"[" * 20_000, ": is nested"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_yaml_that_cannot_be_read_is_one_line_with_file_and_line(tmp_path, monkeypatch, wrong):
    content, said = WRONG[wrong]
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "odd.yaml"
    file.write_bytes(content)
    with pytest.raises(UsageError) as caught:
        read_yaml(file)
    assert str(caught.value).startswith(f"{file}{said}")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "PWNED").exists()
