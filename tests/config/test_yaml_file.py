"""YAML of a user, or of a stranger, is data, or one line that says what is wrong with it."""

import pytest

from flowrep.config.usage import UsageError
from flowrep.config.yaml_file import read_yaml

# Each list holds the one before twice: 2 ** 17 - 1 values and lists in line 16.
DOUBLED = "a0: &a0 [x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60)
)
WRONG = {
    "a list that is not closed": (b"name: a\nroads: [1\n", ", line 3: "),
    "a key twice": (b"name: a\nname: b", ", line 2: the key 'name'"),
    "a tag that calls": (b"!!python/object/apply:os.system ['touch PWNED']", ", line 1: "),
    "a tag of a module": (b"a: !!python/name:os.system", ", line 1: "),
    "a date that is none": (b"a: 2001-99-99", ": "),
    "a tagged date that is none": (b"a: !!timestamp x", ": "),
    "a truth that is none": (b"a: !!bool x", ": "),
    "no UTF-8": (b"name: \xff\xfe", ": "),
    "aliases of aliases": (DOUBLED.encode(), ", line 16: its aliases"),
    "an endless alias": (b"name: &a {b: *a}", ", line 1: an alias"),
    "a number of 401 digits": (b"a: 1" + b"0" * 400, ", line 1: a number"),
    "a number of 6,000 digits": (b"a: 0x1" + b"0" * 5000, ", line 1: a number"),
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
